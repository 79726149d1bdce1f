"""Messages as arrays: the heads of all messages of some chunks, and where their data stand."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from mcap.opcode import Opcode
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from bilprov.captures.storage import records
from bilprov.captures.storage.records import DESCRIPTIONS, MESSAGE_HEAD, RECORD_HEAD, Damaged

BLOCK_MESSAGES: Final = 64 * 1024
BLOCK_BYTES: Final = 4 * 1024 * 1024
"""Chunks are joined to blocks of about this size, since small arrays cost as much as large ones."""

_WORTH_AN_INDEX = 64  # messages in a chunk; fewer are found as fast without
_SMALL = 16  # bytes of a message
_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_FRONT = records.RECORD_HEAD.size


class Stored(NamedTuple):
    """A message as stored in the file; `lost` says what is missing before it, "" for nothing."""

    log_time: int
    sequence: int
    channel: int
    data: bytes
    lost: str


_COLUMNS = ("start", "end", "channel", "sequence", "log_time")


class Messages(Struct, frozen=True, eq=False):
    """Some messages, one row each, between which nothing is missing.

    `start` and `end` are where the data of each message are in `content`; `log_time` is in ns.
    `lost` says what is missing before the first one, "" for nothing.
    """

    content: bytes
    start: NDArray[np.int64]
    end: NDArray[np.int64]
    channel: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    log_time: NDArray[np.uint64]
    lost: str = ""

    @classmethod
    def at(cls, content: bytes, starts: NDArray[np.int64], lost: str = "") -> Messages:
        """The messages whose records begin at `starts` in `content`."""
        heads = _heads(content, starts)
        start = starts + _HEAD.itemsize
        end = starts + _FRONT + heads["length"].astype(np.int64)
        channel, sequence, log_time = heads["channel"], heads["sequence"], heads["log_time"]
        return cls(content, start, end, channel, sequence, log_time, lost)

    def __len__(self) -> int:
        return len(self.start)

    def rows(self, rows: slice | NDArray[Any], lost: str = "") -> Messages:
        """Some of the rows, with what is missing before them."""
        return replace(self, lost=lost, **{name: getattr(self, name)[rows] for name in _COLUMNS})

    def and_then(self, other: Messages) -> Messages:
        """These rows and those of `other`."""
        at = len(self.content)
        moved = replace(other, start=other.start + at, end=other.end + at)
        both = {name: np.append(getattr(self, name), getattr(moved, name)) for name in _COLUMNS}
        return replace(self, content=self.content + other.content, **both)

    def by_time(self) -> Messages:
        """The rows in order of time."""
        rows = np.argsort(self.log_time, kind="stable")
        end = np.cumsum((self.end - self.start)[rows])
        ordered = self.rows(rows, self.lost)
        start = np.append(0, end[:-1])
        return replace(ordered, content=self.data(rows).tobytes(), start=start, end=end)

    def data(self, rows: NDArray[np.intp]) -> NDArray[np.uint8]:
        """The data of some rows, joined in order."""
        start, size = self.start[rows], (self.end - self.start)[rows]
        before = np.cumsum(size) - size
        if int(size.sum()) > _SMALL * len(size):  # places of bytes take 8 times as much
            ends = self.end[rows].tolist()
            parts = [self.content[a:b] for a, b in zip(start.tolist(), ends, strict=True)]
            return np.frombuffer(b"".join(parts), np.uint8)
        places = np.repeat(start - before, size)
        places += np.arange(len(places))
        data: NDArray[np.uint8] = np.frombuffer(self.content, np.uint8)[places]
        return data

    def single(self) -> Iterator[Stored]:
        """Yield the rows as single messages."""
        lost = self.lost
        columns = (getattr(self, name).tolist() for name in _COLUMNS)
        for start, end, channel, sequence, log_time in zip(*columns, strict=True):
            yield Stored(log_time, sequence, channel, self.content[start:end], lost)
            lost = ""


class Piece(NamedTuple):
    """A chunk's unpacked bytes, where its messages begin, and what is lost before it."""

    content: bytes
    starts: NDArray[np.int64]
    lost: str


def blocks_of(pieces: Iterable[Piece]) -> Iterator[Messages]:
    """Join pieces to blocks of messages.

    The first piece comes alone, so that what needs only the first message has it soon.
    """
    held: list[Piece] = []
    messages = size = 0
    most = 1
    for piece in pieces:
        if piece.lost and held:
            yield _joined(held)
            held, messages, size = [], 0, 0
        held.append(piece)
        messages += len(piece.starts)
        size += len(piece.content)
        if messages >= most or size >= BLOCK_BYTES:
            yield _joined(held)
            held, messages, size = [], 0, 0
            most = BLOCK_MESSAGES
    if held:
        yield _joined(held)


def _joined(pieces: list[Piece]) -> Messages:
    lost = pieces[0].lost
    if len(pieces) == 1:
        return Messages.at(pieces[0].content, pieces[0].starts, lost)
    sizes = np.array([len(piece.content) for piece in pieces])
    counts = [len(piece.starts) for piece in pieces]
    starts = np.concatenate([piece.starts for piece in pieces])
    starts += np.repeat(np.cumsum(sizes) - sizes, counts)
    return Messages.at(b"".join([piece.content for piece in pieces]), starts, lost)


Others: TypeAlias = list[tuple[int, int, int]]
"""Records that are no messages: opcode, start and end of the content."""


def message_starts(content: bytes, index: bytes = b"") -> tuple[NDArray[np.int64], Others]:
    """Where the record of each message begins in a chunk's unpacked bytes; and the other records.

    `index` has the entries of the chunk's message indexes, of all channels. Nothing covers them by
    a checksum: they are used where they lead from each message right to the next one, else all
    records are walked. Raises Damaged if a record is inconsistent.
    """
    if len(index) >= 16 * _WORTH_AN_INDEX:
        found = _indexed_starts(content, index)
        if found is not None:
            return found
    starts, others = [], []
    for record in records_in(content):
        if record[0] == Opcode.MESSAGE:
            starts.append(record[1] - _FRONT)
        else:
            others.append(record)
    return np.array(starts, np.int64), others


def _indexed_starts(content: bytes, index: bytes) -> tuple[NDArray[np.int64], Others] | None:
    offsets = np.sort(np.frombuffer(index, "<u8")[1::2], kind="stable")  # each channel's are sorted
    if int(offsets[-1]) + _HEAD.itemsize > len(content):
        return None
    starts = offsets.astype(np.int64)
    heads = _heads(content, starts)
    lengths = heads["length"].astype(np.int64)
    ends = starts + lengths + _FRONT
    if not (
        (heads["opcode"] == Opcode.MESSAGE).all()
        and (ends[:-1] == starts[1:]).all()
        and int(ends[-1]) == len(content)
        and int(lengths.min()) >= records.MESSAGE_HEAD.size
    ):
        return None
    try:
        front = list(records_in(content[: int(starts[0])]))
    except Damaged:
        return None
    return None if any(opcode == Opcode.MESSAGE for opcode, _, _ in front) else (starts, front)


def _heads(content: bytes, starts: NDArray[np.int64]) -> NDArray[Any]:
    places = max(0, len(content) - _HEAD.itemsize + 1)
    # Bytes without a meaning are copied ten times as fast as records of fields.
    raw = np.ndarray((places,), np.dtype((np.void, _HEAD.itemsize)), content, strides=(1,))[starts]
    heads: NDArray[Any] = raw.view(_HEAD)
    return heads


def records_in(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of the content of each record in a chunk's unpacked bytes.

    Raises Damaged if a record is inconsistent, or if there are more than DESCRIPTIONS that are no
    messages: an empty record has 9 bytes, so that a packed chunk may hold millions.
    """
    at = 0
    total = len(content)
    unpack = RECORD_HEAD.unpack_from
    others = 0
    while at < total:
        if at + 9 > total:
            raise Damaged("a chunk ends inside a record")
        opcode, length = unpack(content, at)
        start = at + 9
        at = start + length
        if at > total:
            raise Damaged("a record in a chunk ends after the chunk")
        if opcode != Opcode.MESSAGE:
            others += 1
            if others > DESCRIPTIONS:
                raise Damaged(
                    f"a chunk holds more than {DESCRIPTIONS} records that are not messages"
                )
        elif length < MESSAGE_HEAD.size:
            raise Damaged("a message is shorter than its fields")
        yield opcode, start, at
