"""Surveys a capture file in one pass with bounded memory: intact regions, contents, damage."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from io import BufferedReader
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Statistics
from numpy.typing import NDArray

from bilprov.captures import topics
from bilprov.captures.storage import records
from bilprov.captures.storage.blocks import Messages, Piece, blocks_of
from bilprov.captures.storage.contents import Contents
from bilprov.captures.storage.records import MAGIC, CutOff
from bilprov.captures.storage.recovery import SKIPPED, Found, Lost, RecordFile, read_footer
from bilprov.captures.text import printable
from bilprov.captures.wall_clock import stated_number

DAMAGE_NOTES: Final = 20  # sentences about damage; further damaged places are only counted


class Survey:
    """A survey of an open MCAP file of `size` bytes, whose first bytes were checked before.

    `damage` says what is damaged there, "" for nothing.
    """

    def __init__(self, file: BufferedReader, size: int, damage: str = "") -> None:
        self._records = RecordFile(file, size)
        self._finished = bool(read_footer(file, size))
        self._regions: list[tuple[int, int]] = []
        self._library = ""
        self._metadata: dict[str, str] | None = None
        self._guarded_start: str | None = None
        self._channels: dict[int, Channel] = {}
        self._verified: set[int] = set()
        self._counts: Counter[int] = Counter()
        self._sizes: Counter[int] = Counter()
        self._times: list[int] = []  # first, earliest, latest
        self._too_long = 0
        self._in_order = True
        self._held = np.zeros(0, np.uint64)  # times, of a foreign file in order of time
        self._passed = np.uint64(0)
        self._late = 0
        self.notes = [damage] if damage else []
        """Sentences about what is damaged or left out so far."""
        self._more_notes = 0
        self._left_out = False  # whether a note tells of records that are not read
        self._stated: int | None = None  # messages that the file's statistics count

    def blocks(self) -> Iterator[Messages]:
        """Yield the messages of the file, in blocks, with which the survey goes on."""
        for block in blocks_of(self._pieces()):
            self._count(block)
            yield block

    def _pieces(self) -> Iterator[Piece]:
        """Yield the messages of the file, and take in all else."""
        start = len(MAGIC)
        for found in self._records.walk(start, self._records.size):
            if isinstance(found, Lost):
                self._note_loss(found)
            else:
                self._take(found)
                if len(found.starts):
                    yield Piece(found.content, found.starts, "")
                if self._regions and self._regions[-1][1] == start:
                    start, _ = self._regions.pop()
                end = self._records.size if found.opcode == Opcode.FOOTER else found.end
                self._regions.append((start, end))
            start = found.end

    def contents(self) -> Contents:
        """What was found up to the last block; nothing may be surveyed after it."""
        channels = self._table()
        unknown = sum(n for channel, n in self._counts.items() if channel not in channels)
        if self._too_long:
            self._note(
                f"{self._too_long} messages hold more than the {records.MESSAGE_BYTES} bytes "
                "allowed and are left out"
            )
        if unknown:
            self._note(f"{unknown} messages are on channels that the file does not describe")
        self._put_in_order(np.zeros(0, np.uint64))
        if self._late:
            self._note(f"{self._late} messages stand too far out of time order to be put right")
        held = self._counts.total() + self._too_long
        if not self._left_out and self._stated not in (None, held):
            # Whole records went or came, of which the rest of the file tells nothing.
            self._note(f"{held} messages are there, the file's statistics count {self._stated}")
        if self._more_notes:
            self.notes.append(f"{self._more_notes} further places are damaged")
        own = self._records.own
        first, earliest, last = self._times or (0, 0, 0)
        first = first if own else earliest
        starts = [
            self._guarded_start,
            (self._metadata or {}).get(topics.START_KEY),
            *(one.metadata.get(topics.CHANNEL_START_KEY) for one in self._channels.values()),
        ]
        stated = (start for start in map(stated_number, starts) if start is not None)
        return Contents(
            size=self._records.size,
            regions=tuple(self._regions),
            own=own,
            in_order=self._in_order,
            counted=self._library.startswith(records.OWN_LIBRARY),
            library=printable(self._library),
            metadata=self._metadata or {},
            start=next(stated, first),
            channels=channels,
            first=first,
            last=last,
            counts=_by_topic(self._counts, channels),
            sizes=_by_topic(self._sizes, channels),
            unfinished=not self._finished,
            damage=tuple(self.notes),
        )

    def _table(self) -> dict[int, tuple[str, str]]:
        table = {
            one.id: (printable(one.topic), printable(one.message_encoding))
            for one in self._channels.values()
        }
        for topic in topics.TOPICS if self._records.own else ():
            if topic.channel not in self._verified:
                table[topic.channel] = (topic.name, topic.encoding)
        return table

    def _take(self, found: Found) -> None:
        for channel in found.channels:
            self._learn(channel, found.verified)
        match found.record:
            case Header(library=library):
                self._library = library
                self._records.own = library.startswith(records.OWN_LIBRARY)
            case Channel():
                self._learn(found.record, verified=False)
            case Metadata(name=topics.METADATA_NAME) if self._metadata is None:
                self._metadata = found.record.metadata
            case Statistics(message_count=stated):
                self._stated = stated
        if found.opcode == SKIPPED:
            self._left_out = True
            self._note(found.note)

    def _count(self, block: Messages) -> None:
        sizes = block.end - block.start
        if int(sizes.max()) > records.MESSAGE_BYTES:
            fits = sizes <= records.MESSAGE_BYTES
            self._too_long += int(np.count_nonzero(~fits))
            block, sizes = block.rows(fits), sizes[fits]
            if not len(block):
                return
        counts = np.bincount(block.channel)
        held = np.bincount(block.channel, sizes)
        for channel in np.flatnonzero(counts).tolist():
            self._counts[channel] += int(counts[channel])
            self._sizes[channel] += int(held[channel])
        times = block.log_time
        first, earliest, latest = int(times[0]), int(times.min()), int(times.max())
        before = self._times or [first, earliest, earliest]
        if not self._records.own:
            self._in_order &= first >= before[2] and bool((times[1:] >= times[:-1]).all())
            self._put_in_order(times)
        self._times = [before[0], min(before[1], earliest), max(before[2], latest)]

    def _put_in_order(self, times: NDArray[np.uint64]) -> None:
        """Count the messages that come too late to be put in order as reading does it."""
        both = np.sort(np.append(self._held, times), kind="stable")
        passed = both[: len(self._held)]
        self._late += int(np.count_nonzero(passed < self._passed))
        self._passed = passed.max(initial=self._passed)
        self._held = both[len(passed) :]

    def _learn(self, channel: Channel, verified: bool) -> None:
        known = self._channels.get(channel.id)
        if known is None and len(self._channels) >= records.CHANNELS:
            note = f"the file describes more than the {records.CHANNELS} channels allowed"
            if note not in self.notes:
                self._note(note)
            return
        if known is None or (verified and channel.id not in self._verified):
            self._channels[channel.id] = channel
        if verified:
            self._verified.add(channel.id)
            start = channel.metadata.get(topics.CHANNEL_START_KEY)
            if start is not None and self._guarded_start is None:
                self._guarded_start = start
                self._records.own = True

    def _note_loss(self, lost: Lost) -> None:
        self._left_out = True
        if lost.whole_again:
            self._note(f"bytes {lost.start} to {lost.end} are damaged and left out ({lost.damage})")
        elif self._finished or not isinstance(lost.damage, CutOff):
            past = self._records.past_data
            where = "the index at the end is" if past else f"all from byte {lost.start} on is"
            self._note(f"{where} damaged and left out ({lost.damage})")

    def _note(self, sentence: str) -> None:
        if len(self.notes) < DAMAGE_NOTES:
            self.notes.append(sentence)
        else:
            self._more_notes += 1


def _by_topic(numbers: dict[int, int], channels: dict[int, tuple[str, str]]) -> dict[str, int]:
    totals = {topic: 0 for topic, _ in channels.values()}
    for channel, number in numbers.items():
        if channel in channels:
            totals[channels[channel][0]] += number
    return totals
