"""Reads the messages of a surveyed file in order, each with a note of what is lost before it.

Those of foreign writers are sorted by time, with a bounded number of them held back.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedReader
from typing import Generic, NamedTuple, TypeAlias, TypeVar

from bilprov.captures.storage import records
from bilprov.captures.storage.records import (
    ATTACHMENT_BYTES,
    MAGIC,
    MESSAGE_BYTES,
    RECORD_HEAD,
    AttachmentRecord,
    Damaged,
)
from bilprov.captures.storage.recovery import SKIPPED, RecordFile

WINDOW_MESSAGES = 4096  # held back to put a foreign file into time order
WINDOW_BYTES = 16 * 1024 * 1024  # of the messages held back

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Contents:
    """The results of a survey. Times are `log_time` in ns, 0 if there is no message.

    `size` is the file's size in bytes; `regions` are its ranges of complete records, as the first
    byte and the byte after the last. `own` is true if bilprov recorded the file, so that the order
    in the file is the order of events; `counted` is true if no other program rewrote it since, so
    that a jump of `sequence` is a loss. `starts` are the file's statements of its start (digits,
    ns), the best protected one first. `channels` maps channel ids to topic and encoding; `counts`
    and `sizes` are messages and bytes by topic.
    """

    size: int
    regions: tuple[tuple[int, int], ...]
    own: bool
    counted: bool
    library: str
    metadata: dict[str, str]
    starts: tuple[str, ...]
    channels: dict[int, tuple[str, str]]
    first: int
    last: int
    counts: dict[str, int]
    sizes: dict[str, int]
    unfinished: bool
    damage: tuple[str, ...]


class TimeWindow(Generic[Item]):
    """A sorting window that holds back up to 4,096 messages or 16 MiB and yields them by time.

    Messages with equal times keep their order. `late` counts messages that came out after a later
    one, because the window was too small.
    """

    def __init__(self) -> None:
        self.late = 0
        self._held: list[tuple[int, int, int, Item]] = []
        self._bytes = 0
        self._count = 0
        self._latest = 0

    def push(self, time: int, size: int, item: Item) -> Iterator[Item]:
        """Add a message of `size` bytes at `time` (ns); yield those that exceed the window."""
        heapq.heappush(self._held, (time, self._count, size, item))
        self._count += 1
        self._bytes += size
        while len(self._held) > WINDOW_MESSAGES or self._bytes > WINDOW_BYTES:
            yield self._pop()

    def rest(self) -> Iterator[Item]:
        """Yield all messages that are still held."""
        while self._held:
            yield self._pop()

    def _pop(self) -> Item:
        time, _, size, item = heapq.heappop(self._held)
        self._bytes -= size
        if time < self._latest:
            self.late += 1
        self._latest = max(self._latest, time)
        return item


class Stored(NamedTuple):
    """A message as stored in the file; `lost` says what is missing before it, "" for nothing."""

    log_time: int
    sequence: int
    channel: int
    data: bytes
    lost: str


@dataclass(slots=True)
class Order:
    """Where reading stands among the sequence numbers, which go on from one file to the next.

    `expected` is the number of the next message, None where any may come. `missing` names the files
    right before the next one that are not there, "" for none.
    """

    expected: int | None = 0
    missing: str = ""


def stored_messages(file: BufferedReader, contents: Contents, order: Order) -> Iterator[Stored]:
    """Yield the messages of an open file: of our own files in file order, of others by time.

    Raises Damaged if the file has changed since the survey.
    """
    in_file_order = _in_file_order(_spans(file, contents), contents.counted, order)
    if contents.own:
        yield from in_file_order
        return
    window: TimeWindow[Stored] = TimeWindow()
    for message in in_file_order:
        yield from window.push(message.log_time, len(message.data), message)
    yield from window.rest()


class Place(NamedTuple):
    """The place of a message: offset of its chunk, its end in the unpacked chunk, its sequence."""

    chunk: int
    end: int
    sequence: int


def messages_after(
    file: BufferedReader, contents: Contents, order: Order, place: Place | None
) -> Iterator[Stored]:
    """Yield the messages of an own file that was not surveyed, in file order, after that `place`.

    None stands for the start. A damaged part of the file is left out, as a survey would do.
    """
    if place is not None:
        order.expected = place.sequence + 1
    return _in_file_order(_spans_after(file, contents, place), counted=True, order=order)


_Spans: TypeAlias = tuple[bytes, list[tuple[int, int]], str]
"""A chunk's bytes, where the content of each message starts and ends, and what is lost before."""


def _in_file_order(chunks: Iterator[_Spans], counted: bool, order: Order) -> Iterator[Stored]:
    unpack = records.MESSAGE_HEAD.unpack_from
    head = records.MESSAGE_HEAD.size
    lost = order.missing
    begun = False
    expected = 0
    for content, spans, where in chunks:
        if where:
            lost = lost or where
        if spans and not begun:
            begun = True
            sequence = unpack(content, spans[0][0])[1]
            # A part that was written anew, by an edit, counts from 0 again.
            expected = sequence if order.expected is None or sequence == 0 else order.expected
        for start, end in spans:
            data = content[start + head : end]
            if len(data) > MESSAGE_BYTES:
                lost = "a message that is too long is left out here"
                continue
            channel, sequence, log_time, _ = unpack(content, start)
            if counted:
                missing = (sequence - expected) & 0xFFFF_FFFF
                if missing >> 31:
                    continue  # it came before: a chunk that stands in the file a second time
                expected = (sequence + 1) & 0xFFFF_FFFF
                if missing:
                    why = order.missing or "the file is damaged"
                    lost = f"{missing} messages are lost here, {why}"
                else:
                    lost = order.missing
            yield Stored(log_time, sequence, channel, data, lost)
            if lost:
                lost = order.missing = ""
    if begun:
        order.expected = expected if counted else None


def _spans_after(file: BufferedReader, contents: Contents, place: Place | None) -> Iterator[_Spans]:
    source = RecordFile(file, contents.size)
    source.own = True
    offset = len(MAGIC) if place is None else place.chunk
    passed = 0 if place is None else place.end
    while offset < contents.size:
        try:
            found = source.record(offset)
            if found.opcode == records.CHUNK:
                spans = records.messages_in(found.content)
                source.count_messages(len(spans))
                yield found.content, [span for span in spans if span[0] >= passed], ""
        except Damaged:
            resumed = source.next_chunk(offset + 1)
            if resumed is None:
                return
            offset, passed = resumed, 0
            continue
        if found.opcode == records.DATA_END:
            return
        offset, passed = found.end, 0


def _spans(file: BufferedReader, contents: Contents) -> Iterator[_Spans]:
    # The survey has checked each record of these regions; here they only must still be complete.
    source = RecordFile(file, contents.size)
    source.past_data = True
    where = ""
    for at, region_end in contents.regions:
        offset = at
        while offset < region_end:
            found = source.record(offset)
            offset = found.end
            if found.opcode == records.CHUNK:
                spans = records.messages_in(found.content)
                yield found.content, spans, where
                if spans:
                    where = ""
            elif found.opcode == records.MESSAGE:
                yield found.content, [(0, len(found.content))], where
                where = ""
            elif found.opcode == SKIPPED:
                where = "a chunk or message that is too large is left out here"
            elif found.opcode == records.FOOTER:
                return
        where = "the file is damaged here"


def attachments(file: BufferedReader, contents: Contents) -> Iterator[AttachmentRecord]:
    """Yield the complete attachments of an open file, in file order; nothing else is read.

    Raises Damaged if the file has changed since the survey.
    """
    for at, region_end in contents.regions:
        offset = at
        while offset < region_end:
            file.seek(offset)
            head = file.read(RECORD_HEAD.size)
            if len(head) < RECORD_HEAD.size:
                raise Damaged("it has another size")
            opcode, length = RECORD_HEAD.unpack(head)
            offset += RECORD_HEAD.size + length
            if opcode == records.FOOTER:
                return
            if opcode == records.ATTACHMENT and length <= ATTACHMENT_BYTES + MESSAGE_BYTES:
                try:
                    yield records.attachment_record(file.read(length), contents.own)
                except Damaged:  # nobody looked at those of foreign files
                    continue
