"""Reads the messages of a surveyed file in order, each with a note of what is lost before it.

Those of foreign writers are sorted by time, with a bounded number of them held back.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BufferedReader
from itertools import chain
from typing import Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np

from bilprov.captures.storage import records
from bilprov.captures.storage.blocks import Messages, Piece, Stored, blocks_of, message_starts
from bilprov.captures.storage.records import MESSAGE_BYTES, AttachmentRecord, Damaged
from bilprov.captures.storage.recovery import SKIPPED, Lost, RecordFile

_WITH_MESSAGES = {records.CHUNK, records.MESSAGE}
WINDOW_MESSAGES = 4096  # held back to put a foreign file into time order
WINDOW_BYTES = 16 * 1024 * 1024  # of the messages held back

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Contents:
    """The results of a survey. Times are `log_time` in ns, 0 if there is no message.

    `size` is the file's size in bytes; `regions` are its ranges of complete records, as the first
    byte and the byte after the last. `own` is true if bilprov recorded the file, so that the order
    in the file is the order of events; `in_order` is true if the messages of another program's file
    stand in order of time; `counted` is true if no other program rewrote it since, so
    that a jump of `sequence` is a loss. `starts` are the file's statements of its start (digits,
    ns), the best protected one first. `channels` maps channel ids to topic and encoding; `counts`
    and `sizes` are messages and bytes by topic.
    """

    size: int
    regions: tuple[tuple[int, int], ...]
    own: bool
    in_order: bool
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

    def pass_over(self, times: list[int]) -> None:
        """Let messages through that no message before is later than, and after which a window's
        worth of later ones comes, so that all before them goes too.
        """
        if times:
            for _ in self.rest():
                pass
            self._latest = times[-1]

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


@dataclass(slots=True)
class Order:
    """Where reading stands among the sequence numbers, which go on from one file to the next.

    `expected` is the number of the next message, None where any may come. `missing` names the files
    right before the next one that are not there, "" for none.
    """

    expected: int | None = 0
    missing: str = ""


Part: TypeAlias = Messages | Stored
"""Messages before and between which nothing is missing, or a single one."""


def stored_parts(
    file: BufferedReader, contents: Contents, order: Order, surveyed: bool, place: Place | None
) -> Iterator[Part]:
    """Yield the messages of an open file: of our own files in file order, of others by time.

    Those of an own file that was not `surveyed` begin after a `place`, None for the start; a
    damaged part of it is left out, as a survey would do. Raises Damaged if the file has changed
    since the survey.
    """
    if place is not None:
        order.expected = place.sequence + 1
    parts = _in_file_order(_pieces(file, contents, place, surveyed), contents.counted, order)
    if contents.own or contents.in_order:
        yield from parts
        return
    window: TimeWindow[Stored] = TimeWindow()
    for message in single(parts):
        yield from window.push(message.log_time, len(message.data), message)
    yield from window.rest()


def single(parts: Iterable[Part]) -> Iterator[Stored]:
    """Yield the messages one by one."""
    for part in parts:
        if isinstance(part, Stored):
            yield part
        else:
            yield from part.single()


def split(parts: Iterator[Part]) -> tuple[Stored | None, Iterator[Part]]:
    """The first message, None if there is none, and the rest."""
    begin = next(parts, None)
    if isinstance(begin, Messages):
        return next(begin.single()), chain([begin.rows(slice(1, None))], parts)
    return begin, parts


class Place(NamedTuple):
    """The place of a message: offset of its chunk, its end in the unpacked chunk, its sequence."""

    chunk: int
    end: int
    sequence: int


def messages_before(
    file: BufferedReader, contents: Contents, chunks: Iterable[int], channel: int
) -> Iterator[tuple[Stored, Place]]:
    """Yield the messages on a channel of the chunks at some offsets; of each the last one first."""
    source = RecordFile(file, contents.size)
    source.own = True
    for offset in chunks:
        try:
            found = source.record(offset)
            starts, _ = message_starts(found.content)
        except Damaged:
            continue
        if found.opcode == records.CHUNK:
            block = Messages.at(found.content, starts)
            block = block.rows(block.channel == channel)
            places = [Place(offset, end, 0) for end in block.end.tolist()]
            for message, place in reversed(list(zip(block.single(), places, strict=True))):
                yield message, place._replace(sequence=message.sequence)


def _in_file_order(pieces: Iterator[Piece], counted: bool, order: Order) -> Iterator[Part]:
    reading = _Reading(order, counted)
    for block, where in blocks_of(pieces):
        if not len(block):
            reading.lost = reading.lost or where
        elif reading.is_straight(block, where):
            yield block
        else:
            yield from reading.singly(block, where)
    reading.finish()


class _Reading:
    """Where reading stands among the sequence numbers of one file, and what is lost up to there."""

    def __init__(self, order: Order, counted: bool) -> None:
        self.lost = order.missing
        self._order = order
        self._counted = counted
        self._expected: int | None = None  # None before the first message

    def is_straight(self, block: Messages, where: str) -> bool:
        """Whether nothing is missing or left out before and in a block; then it counts as read."""
        self._begin(block)
        sequence = block.sequence
        if (
            self.lost
            or where
            or self._order.missing
            or int((block.end - block.start).max()) > MESSAGE_BYTES
            or (
                self._counted
                and (int(sequence[0]) != self._expected or (np.diff(sequence) != 1).any())
            )
        ):
            return False
        self._expected = (int(sequence[-1]) + 1) & 0xFFFF_FFFF
        return True

    def singly(self, block: Messages, where: str) -> Iterator[Stored]:
        """Yield the messages of a block that are to be read, with what is lost before each."""
        self._begin(block)
        expected = self._expected or 0
        order = self._order
        lost = self.lost or where
        for message in block.single():
            if len(message.data) > MESSAGE_BYTES:
                lost = "a message that is too long is left out here"
                continue
            if self._counted:
                missing = (message.sequence - expected) & 0xFFFF_FFFF
                if missing >> 31:
                    continue  # it came before: a chunk that stands in the file a second time
                expected = (message.sequence + 1) & 0xFFFF_FFFF
                if missing:
                    why = order.missing or "the file is damaged"
                    lost = f"{missing} messages are lost here, {why}"
                else:
                    lost = order.missing
            yield message._replace(lost=lost) if lost else message
            if lost:
                lost = order.missing = ""
        self.lost, self._expected = lost, expected

    def finish(self) -> None:
        """Say what the next file has to begin with."""
        if self._expected is not None:
            self._order.expected = self._expected if self._counted else None

    def _begin(self, block: Messages) -> None:
        if self._expected is None:
            first, expected = int(block.sequence[0]), self._order.expected
            # A part that was written anew, by an edit, counts from 0 again.
            self._expected = first if expected is None or first == 0 else expected


def _pieces(
    file: BufferedReader, contents: Contents, place: Place | None, surveyed: bool
) -> Iterator[Piece]:
    source = RecordFile(file, contents.size)
    # A survey has checked each record of the regions, which only must still be complete.
    source.own = not surveyed
    only = _WITH_MESSAGES if surveyed else None
    where, passed = "", 0 if place is None else place.end
    for first, end in contents.regions:
        for found in source.walk(first if place is None else place.chunk, end, only):
            if isinstance(found, Lost):
                if surveyed:
                    raise found.damage
            elif found.opcode in _WITH_MESSAGES:
                starts = found.starts[found.starts >= passed]
                if len(starts):
                    yield Piece(found.content, starts, where)
                    where = ""
            elif found.opcode == SKIPPED:
                where = "a chunk or message that is too large is left out here"
            elif found.opcode == records.DATA_END and not surveyed:
                return
            passed = 0
        where = "the file is damaged here"


def attachments(file: BufferedReader, contents: Contents) -> Iterator[AttachmentRecord]:
    """Yield the complete attachments of an open file, in file order; nothing else is read.

    Raises Damaged if the file has changed since the survey.
    """
    source = RecordFile(file, contents.size)
    source.own = contents.own
    for start, end in contents.regions:
        for found in source.walk(start, end, only=()):
            if isinstance(found, Lost):
                raise found.damage
            if found.opcode == records.ATTACHMENT:
                with suppress(Damaged):  # nobody looked at those of foreign files
                    content = source.record(start, {records.ATTACHMENT}).content
                    yield records.attachment_record(content, contents.own)
            start = found.end
