"""Surveys a capture file in one pass with bounded memory: intact regions, contents, damage."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BufferedReader
from typing import Final

import msgspec

from bilprov.captures import topics
from bilprov.captures.schemas import Line
from bilprov.captures.storage import records
from bilprov.captures.storage.messages import Contents, TimeWindow
from bilprov.captures.storage.records import MAGIC, ChannelRecord, CutOff, Damaged
from bilprov.captures.storage.recovery import SKIPPED, Found, RecordFile

DAMAGE_NOTES: Final = 20  # sentences about damage; further damaged places are only counted
OWN_LINE: Final = topics.BY_VALUE[Line].channel
JSON_ERRORS: Final = (msgspec.MsgspecError, ValueError, RecursionError)
"""Exceptions for JSON that cannot be decoded; deep nesting raises RecursionError."""


def surveyed(file: BufferedReader, size: int, damage: str = "") -> Contents:
    """Survey an open MCAP file of `size` bytes, whose magic at the start was checked before.

    `damage` says what is damaged there, "" for nothing.
    """
    survey = _Survey(file, size, damage)
    survey.walk()
    return survey.contents()


@dataclass(slots=True)
class _Tally:
    """Counts of messages and bytes by channel id, and the times, of one chunk or of a file."""

    counts: Counter[int] = field(default_factory=Counter)
    sizes: Counter[int] = field(default_factory=Counter)
    times: list[int] = field(default_factory=list)  # first, earliest, latest
    too_long: int = 0
    bad_lines: int = 0

    def message(self, channel: int, time: int, size: int) -> None:
        """Count one message."""
        self.counts[channel] += 1
        self.sizes[channel] += size
        if not self.times:
            self.times = [time, time, time]
        elif time > self.times[2]:
            self.times[2] = time
        elif time < self.times[1]:
            self.times[1] = time

    def add(self, other: _Tally) -> None:
        """Add the counts of another tally, whose messages come later in the file."""
        self.counts.update(other.counts)
        self.sizes.update(other.sizes)
        if not self.times:
            self.times = other.times
        elif other.times:
            self.times[1] = min(self.times[1], other.times[1])
            self.times[2] = max(self.times[2], other.times[2])
        self.too_long += other.too_long
        self.bad_lines += other.bad_lines


class _Survey:
    def __init__(self, file: BufferedReader, size: int, damage: str) -> None:
        self._records = RecordFile(file, size)
        self._size = size
        self._finished = _has_end(file, size)
        self._regions: list[tuple[int, int]] = []
        self._library = ""
        self._metadata: dict[str, str] = {}
        self._seen_metadata = False
        self._guarded_start: str | None = None
        self._channels: dict[int, ChannelRecord] = {}
        self._verified: set[int] = set()
        self._tally = _Tally()
        self._order: TimeWindow[None] = TimeWindow()
        self._in_order = True
        self._latest = 0
        self._notes = [damage] if damage else []
        self._more_notes = 0
        self._lines: set[int] = set()
        self._left_out = False  # whether a note tells of records that are not read
        self._stated: int | None = None  # messages that the file's statistics count
        self._expected: int | None = None  # the sequence of the next message of our own files

    def walk(self) -> None:
        offset = len(MAGIC)
        while offset < self._size:
            start = offset
            try:
                found = self._records.record(offset)
                self._take(found)
            except Damaged as damage:
                offset = self._resumed(offset, damage)
                continue
            offset = found.end
            if found.opcode == records.FOOTER:
                offset = self._size
            self._extend(start, offset)

    def contents(self) -> Contents:
        channels = self._table()
        unknown = sum(n for channel, n in self._tally.counts.items() if channel not in channels)
        if self._tally.too_long:
            self._note(
                f"{self._tally.too_long} messages hold more than the {records.MESSAGE_BYTES} bytes "
                "allowed and are left out"
            )
        if self._tally.bad_lines:
            self._note(
                f"{self._tally.bad_lines} messages on /line cannot be decoded and are left out"
            )
        if unknown:
            self._note(f"{unknown} messages are on channels that the file does not describe")
        for _ in self._order.rest():
            pass
        if self._order.late:
            self._note(
                f"{self._order.late} messages stand too far out of time order to be put right"
            )
        held = self._tally.counts.total() + self._tally.too_long
        if not self._left_out and self._stated not in (None, held):
            # Whole records went or came, of which the rest of the file tells nothing.
            self._note(f"{held} messages are there, the file's statistics count {self._stated}")
        if self._more_notes:
            self._notes.append(f"{self._more_notes} further places are damaged")
        own = self._records.own
        first, earliest, last = self._tally.times or (0, 0, 0)
        return Contents(
            size=self._size,
            regions=tuple(self._regions),
            own=own,
            in_order=self._in_order,
            counted=self._library.startswith(records.OWN_LIBRARY),
            library=self._library,
            metadata=self._metadata,
            starts=tuple(self._starts()),
            channels=channels,
            first=first if own else earliest,
            last=last,
            counts=_by_topic(self._tally.counts, channels),
            sizes=_by_topic(self._tally.sizes, channels),
            unfinished=not self._finished,
            damage=tuple(self._notes),
        )

    def _starts(self) -> Iterator[str]:
        if self._guarded_start is not None:
            yield self._guarded_start
        if topics.START_KEY in self._metadata:
            yield self._metadata[topics.START_KEY]
        for channel in self._channels.values():
            if topics.CHANNEL_START_KEY in channel.metadata:
                yield channel.metadata[topics.CHANNEL_START_KEY]

    def _table(self) -> dict[int, tuple[str, str]]:
        table = {record.id: (record.topic, record.encoding) for record in self._channels.values()}
        if self._records.own:
            for topic in topics.TOPICS:
                if topic.channel not in self._verified:
                    table[topic.channel] = (topic.name, topic.encoding)
        return table

    def _take(self, found: Found) -> None:
        if found.opcode == records.CHUNK:
            self._take_chunk(found)
        elif found.opcode == records.MESSAGE:
            self._count(self._tally, found.content, 0, len(found.content), self._lines)
        elif found.opcode == records.HEADER:
            self._library = records.header_library(found.content)
            self._records.own = self._library.startswith(records.OWN_LIBRARY)
            if self._records.own:
                self._lines = {OWN_LINE}
        elif found.opcode == records.CHANNEL:
            self._learn(records.channel_record(found.content), verified=False)
        elif found.opcode == records.METADATA:
            name, pairs = records.metadata_record(found.content)
            if name == topics.METADATA_NAME and not self._seen_metadata:
                self._metadata, self._seen_metadata = pairs, True
        elif found.opcode == records.DATA_END:
            self._records.past_data = True
        elif found.opcode == records.STATISTICS:
            self._stated = records.statistics_record(found.content).messages
        elif found.opcode == SKIPPED:
            self._left_out = True
            self._note(found.note)

    def _take_chunk(self, found: Found) -> None:
        # The chunk has a tally of its own at first, since a damaged chunk is left out as a whole.
        content = found.content
        tally = _Tally()
        channels: list[ChannelRecord] = []
        lines = set(self._lines)
        last: int | None = None
        for opcode, start, end in records.records_in(content):
            if opcode == records.MESSAGE:
                if last is None:
                    self._require_new(content, start)
                last = start
                self._count(tally, content, start, end, lines)
            elif opcode == records.CHANNEL and len(channels) <= records.CHANNELS:
                channel = records.channel_record(content[start:end])
                channels.append(channel)
                if channel.topic == topics.LINE:
                    lines.add(channel.id)
        self._records.count_messages(tally.counts.total() + tally.too_long)
        for channel in channels:
            self._learn(channel, found.verified)
        if last is not None:
            self._expected = records.MESSAGE_HEAD.unpack_from(content, last)[1] + 1
        self._tally.add(tally)

    def _require_new(self, content: bytes, start: int) -> None:
        """Raise Damaged for a chunk of ours whose first message was in the file before.

        Two copies of a chunk are what a repair by a file system, or a careless tool, may leave.
        """
        if not self._records.own or self._expected is None:
            return
        if records.sequences_from(content, start, self._expected) < 0:
            raise Damaged("a chunk stands in the file a second time")

    def _count(self, tally: _Tally, content: bytes, start: int, end: int, lines: set[int]) -> None:
        channel, _, time, _ = records.MESSAGE_HEAD.unpack_from(content, start)
        start += records.MESSAGE_HEAD.size
        size = end - start
        if size > records.MESSAGE_BYTES:
            tally.too_long += 1
            return
        tally.message(channel, time, size)
        if not self._records.own:
            self._in_order &= time >= self._latest
            self._latest = time
            for _ in self._order.push(time, size, None):
                pass
        if channel in lines:
            try:
                msgspec.json.decode(content[start:end], type=Line)
            except JSON_ERRORS:
                tally.bad_lines += 1

    def _learn(self, channel: ChannelRecord, verified: bool) -> None:
        known = self._channels.get(channel.id)
        if known is None and len(self._channels) >= records.CHANNELS:
            note = f"the file describes more than the {records.CHANNELS} channels allowed"
            if note not in self._notes:
                self._note(note)
            return
        if known is None or (verified and channel.id not in self._verified):
            self._channels[channel.id] = channel
            self._lines.discard(channel.id)
            if channel.topic == topics.LINE:
                self._lines.add(channel.id)
        if verified:
            self._verified.add(channel.id)
            start = channel.metadata.get(topics.CHANNEL_START_KEY)
            if start is not None and self._guarded_start is None:
                self._guarded_start = start
                self._records.own = True

    def _resumed(self, offset: int, damage: Damaged) -> int:
        self._left_out = True
        at = self._records.next_chunk(offset + 1)
        if at is not None:
            self._note(f"bytes {offset} to {at} are damaged and left out ({damage})")
            return at
        if self._finished or not isinstance(damage, CutOff):
            where = (
                "the index at the end is"
                if self._records.past_data
                else f"all from byte {offset} on is"
            )
            self._note(f"{where} damaged and left out ({damage})")
        return self._size

    def _extend(self, start: int, end: int) -> None:
        if self._regions and self._regions[-1][1] == start:
            self._regions[-1] = (self._regions[-1][0], end)
        else:
            self._regions.append((start, end))

    def _note(self, sentence: str) -> None:
        if len(self._notes) < DAMAGE_NOTES:
            self._notes.append(sentence)
        else:
            self._more_notes += 1


def _has_end(file: BufferedReader, size: int) -> bool:
    end = records.RECORD_HEAD.pack(records.FOOTER, records.FOOTER_BYTES)
    tail = len(end) + records.FOOTER_BYTES + len(MAGIC)
    if size < len(MAGIC) + tail:
        return False
    file.seek(size - tail)
    last = file.read(tail)
    return last.startswith(end) and last.endswith(MAGIC)


def _by_topic(numbers: dict[int, int], channels: dict[int, tuple[str, str]]) -> dict[str, int]:
    totals = {topic: 0 for topic, _ in channels.values()}
    for channel, number in numbers.items():
        if channel in channels:
            totals[channels[channel][0]] += number
    return totals
