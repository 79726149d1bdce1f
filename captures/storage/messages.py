"""Reads the messages of a surveyed file in order, each with a note of what is lost before it.

Those of foreign writers are sorted by time, with a block of them held back.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BufferedReader
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment

from bilprov.captures import topics
from bilprov.captures.schemas import Checkpoint
from bilprov.captures.storage.blocks import Messages, Piece, message_starts
from bilprov.captures.storage.index import Contents
from bilprov.captures.storage.records import MESSAGE_BYTES, Damaged, decoded
from bilprov.captures.storage.recovery import SKIPPED, Lost, RecordFile

_WITH_MESSAGES = {Opcode.CHUNK, Opcode.MESSAGE}
_TOO_LONG = "a message that is too long is left out here"


@dataclass(slots=True)
class Order:
    """Where reading stands among the sequence numbers, which go on from one file to the next.

    `expected` is the number of the next message, None where any may come. `missing` names the files
    right before the next one that are not there, "" for none.
    """

    expected: int | None = 0
    missing: str = ""


def put_in_order(
    blocks: Iterator[Messages], contents: Contents, order: Order
) -> Iterator[Messages]:
    """Yield those messages of a file's blocks that are to be read.

    Those of our own files come in file order, those of others by time.
    """
    blocks = _in_file_order(blocks, contents.counted, order)
    return blocks if contents.own or contents.in_order else _by_time(blocks)


def _by_time(blocks: Iterable[Messages]) -> Iterator[Messages]:
    """Sort messages by time, those of a block among those of the block before.

    What is missing between two blocks stays between them.
    """
    held: Messages | None = None
    for block in blocks:
        if held is None or block.lost:
            if held is not None:
                yield held
            held = block.by_time()
            continue
        both = held.and_then(block).by_time()
        yield both.rows(slice(len(held)), both.lost)
        held = both.rows(slice(len(held), None))
    if held is not None:
        yield held


class Place(NamedTuple):
    """The place of a message: offset of its chunk, its end in the unpacked chunk, its sequence."""

    chunk: int
    end: int
    sequence: int


def checkpoints_before(
    file: BufferedReader, contents: Contents, time: int
) -> Iterator[tuple[int, Checkpoint, Place]]:
    """Yield the checkpoints in chunks that begin before a log time (ns), the last one first.

    Each comes with the log time and the place of its message.
    """
    source = RecordFile(file, contents.size)
    source.own = True
    channel = topics.BY_VALUE[Checkpoint].channel
    for first, offset in reversed(contents.index.chunks if contents.index else ()):
        if first >= time:
            continue
        try:
            found = source.record(offset)
            starts, _ = message_starts(found.content)
        except Damaged:
            continue
        if found.opcode == Opcode.CHUNK:
            block = Messages.at(found.content, starts)
            block = block.rows(block.channel == channel)
            for message, end in reversed([*zip(block.single(), block.end.tolist(), strict=True)]):
                value = decoded(message.data, Checkpoint)
                if value is not None:
                    yield message.log_time, value, Place(offset, end, message.sequence)


def _in_file_order(blocks: Iterator[Messages], counted: bool, order: Order) -> Iterator[Messages]:
    """Yield the messages that are to be read, in blocks with what is missing before each.

    Left out are those that are too long, and those that came before: of a chunk that stands in the
    file a second time. With `counted` a jump of the sequence numbers tells what is missing.
    """
    lost, expected = order.missing, -1
    for block in blocks:
        lost = lost or block.lost
        rows = np.flatnonzero(block.end - block.start <= MESSAGE_BYTES)
        notes = dict.fromkeys(np.flatnonzero(np.diff(rows, prepend=-1) > 1).tolist(), _TOO_LONG)
        if counted and len(rows):
            if expected < 0:
                first = int(block.sequence[0])
                # A part that was written anew, by an edit, counts from 0 again.
                expected = first if order.expected is None or first == 0 else order.expected
            ahead = (block.sequence[rows] - np.uint32(expected)).view(np.int32).astype(np.int64)
            before = np.maximum.accumulate(np.append(-1, ahead))
            expected = (expected + int(before[-1]) + 1) & 0xFFFF_FFFF
            new = ahead > before[:-1]
            rows, missing = rows[new], (ahead - before[:-1])[new] - 1
            notes = {
                at: f"{missing[at]} messages are lost here, "
                f"{(order.missing if at == 0 else '') or 'the file is damaged'}"
                for at in np.flatnonzero(missing).tolist()
            }
            lost = order.missing
        if not len(rows):
            continue
        if lost:
            notes.setdefault(0, lost)
        lost = order.missing = ""
        whole = block if len(rows) == len(block) else block.rows(rows)
        for start, stop in pairwise([*sorted({0, *notes}), len(rows)]):
            yield whole.rows(slice(start, stop), notes.get(start, ""))
    order.expected = expected if counted and expected >= 0 else order.expected
    if not counted:
        order.expected = None


def pieces(file: BufferedReader, contents: Contents, place: Place | None) -> Iterator[Piece]:
    """Yield the messages of an open file.

    Those of a file that was opened by its index begin after a `place`, None for the start; a
    damaged part of it is left out, as a survey would do. Raises Damaged if the file has changed
    since the survey.
    """
    surveyed = contents.index is None
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
                starts = found.starts[found.starts >= passed] if passed else found.starts
                if len(starts):
                    yield Piece(found.content, starts, where)
                    where = ""
            elif found.opcode == SKIPPED:
                where = "a chunk or message that is too large is left out here"
            elif found.opcode == Opcode.DATA_END and not surveyed:
                return
            passed = 0
        where = "the file is damaged here"


def attachments(file: BufferedReader, contents: Contents) -> Iterator[Attachment]:
    """Yield the complete attachments of an open file, in file order; nothing else is read.

    Raises Damaged if the file has changed since the survey.
    """
    source = RecordFile(file, contents.size)
    source.own = contents.own
    for start, end in contents.regions:
        for found in source.walk(start, end, only=()):
            if isinstance(found, Lost):
                raise found.damage
            if found.opcode == Opcode.ATTACHMENT:
                with suppress(Damaged):  # nobody looked at those of foreign files
                    yield source.record(start, {Opcode.ATTACHMENT}).record
            start = found.end
