"""What a capture file holds: its contents, by the index at its end, and its messages in order.

What does not fit means that there is no index: the summary's checksum, the order and the places of
its chunks, its channels. Its counts and times are believed, since its checksum is right.

Each message comes with a note of what is lost before it. Those of foreign writers are sorted by
time, with a block of them held back.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BufferedReader
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Header, Metadata

from bilprov.captures import topics
from bilprov.captures.schemas import Checkpoint
from bilprov.captures.storage import records
from bilprov.captures.storage.blocks import Messages, Piece, message_starts
from bilprov.captures.storage.records import MAGIC, Damaged, decoded
from bilprov.captures.storage.recovery import SKIPPED, Lost, RecordFile, parsed, read_footer
from bilprov.captures.text import printable
from bilprov.captures.wall_clock import stated_number

SUMMARY_BYTES: Final = 64 * 1024 * 1024  # enough for half a million chunks

_PASSED: Final = {
    Opcode.SCHEMA,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
}

_DATA_END = struct.Struct("<BQI")  # opcode, length; CRC over all data, 0 for none
_FOOTER = struct.Struct("<BQQQI")  # opcode, length; summary start, summary offset start, CRC
_END = _FOOTER.size + len(MAGIC)
_ENTRY = struct.Struct("<BQQQQQ")  # opcode, length; times, offset and length of the chunk

_WITH_MESSAGES = {Opcode.CHUNK, Opcode.MESSAGE}
_TOO_LONG = "a message that is too long is left out here"


@dataclass(frozen=True, slots=True)
class Index:
    """The index of a file: `chunks` are when each begins (log time, ns), and where it stands.

    `data_end` is the offset after the last chunk and attachment; `data_crc` is the checksum of all
    before, 0 if there is none.
    """

    data_end: int
    data_crc: int
    chunks: list[tuple[int, int]] = field(repr=False)

    def covers(self, file: BufferedReader) -> bool:
        """Whether the checksum over all data, which older kits did not write, is right."""
        file.seek(0)
        crc, left = 0, self.data_end
        while left and (data := file.read(min(left, 1 << 20))):
            crc = zlib.crc32(data, crc)
            left -= len(data)
        return self.data_crc == crc


@dataclass(frozen=True, slots=True)
class Contents:
    """The results of a survey. Times are `log_time` in ns, 0 if there is no message.

    `size` is the file's size in bytes; `regions` are its ranges of complete records, as the first
    byte and the byte after the last. `own` is true if bilprov recorded the file, so that the order
    in the file is the order of events; `in_order` is true if the messages of another program's file
    stand in order of time; `counted` is true if no other program rewrote it since, so
    that a jump of `sequence` is a loss. `start` is the wall clock (ns) from which times count: the
    best protected one that the file states, else that of the first message. `channels` maps channel
    ids to topic and encoding; `counts` and `sizes` are messages and bytes by topic. `index` is that
    of a file that was opened by it.
    """

    size: int
    library: str
    metadata: dict[str, str]
    start: int
    channels: dict[int, tuple[str, str]]
    first: int
    last: int
    counts: dict[str, int]
    regions: tuple[tuple[int, int], ...]
    sizes: dict[str, int] = field(default_factory=dict)
    own: bool = True
    in_order: bool = True
    counted: bool = True
    unfinished: bool = False
    damage: tuple[str, ...] = ()
    index: Index | None = None


def read_index(file: BufferedReader, size: int) -> Contents | None:
    """The contents of an open file of `size` bytes as its index tells them, without bytes by topic.

    None if the file is foreign or unfinished, does not say when it began, has no raw topic or no
    index, or one that does not fit.
    """
    try:
        return _read_index(file, size)
    except (Damaged, struct.error):
        return None


def _read_index(file: BufferedReader, size: int) -> Contents:
    if file.read(len(MAGIC)) != MAGIC:
        raise Damaged("the first bytes are damaged")
    source = RecordFile(file, size)
    source.own = True
    header = source.record(len(MAGIC))
    about = source.record(header.end)
    match header.record, about.record:
        case Header(library=library), Metadata(name=topics.METADATA_NAME, metadata=metadata) if (
            library.startswith(records.OWN_LIBRARY)
        ):
            start = metadata.get(topics.START_KEY)
        case _:
            raise Damaged("the file does not begin as bilprov's do")
    data_end, summary, data_crc = _end(file, size)
    known = {topic.channel: (topic.name, topic.encoding) for topic in topics.TOPICS}
    table: dict[int, tuple[str, str]] = {}
    stated = None
    chunks: list[tuple[int, int]] = []
    at, end, reached = 0, len(summary) - _END, about.end
    entry = _ENTRY.unpack_from
    while at < end:
        # The footer behind the records makes this front complete for the shortest record too.
        opcode, length, first, _, offset, chunk = entry(summary, at)
        if opcode == Opcode.CHUNK_INDEX:
            if offset < reached:
                raise Damaged("a chunk's entry does not fit")
            reached = offset + chunk
            chunks.append((first, offset))
        elif opcode == Opcode.CHANNEL:
            channel = parsed(opcode, summary[at + 9 : at + 9 + length], own=True)
            table[channel.id] = channel.topic, channel.message_encoding
            began = channel.metadata.get(topics.CHANNEL_START_KEY)
            if table[channel.id] != known.get(channel.id) or began != start:
                raise Damaged("a channel is not one of bilprov's")
        elif opcode == Opcode.STATISTICS:
            stated = parsed(opcode, summary[at + 9 : at + 9 + length], own=True)
        elif opcode not in _PASSED:
            raise Damaged("what stands there is no record of a summary")
        at += 9 + length
    topics_held = {topic for topic, _ in table.values()}
    started = stated_number(start)
    if (
        at != end
        or reached > data_end
        or stated is None
        or started is None
        or topics_held.isdisjoint({topics.HOST_RAW, topics.DEVICE_RAW})
    ):
        raise Damaged("the index does not fit")
    counts = stated.channel_message_counts
    return Contents(
        size=size,
        library=printable(library),
        metadata=metadata,
        start=started,
        channels=table,
        first=stated.message_start_time,
        last=stated.message_end_time,
        counts={topic: counts.get(channel, 0) for channel, (topic, _) in table.items()},
        regions=((len(MAGIC), size),),
        index=Index(data_end, data_crc, chunks),
    )


def _end(file: BufferedReader, size: int) -> tuple[int, bytes, int]:
    """Where the data end, the summary with the footer and the magic, and the CRC of all data.

    Raises Damaged.
    """
    _, _, start, _, crc = _FOOTER.unpack_from(read_footer(file, size))  # none: struct.error
    data_end = start - _DATA_END.size
    if not len(MAGIC) <= data_end <= size - _END or size - data_end > SUMMARY_BYTES:
        raise Damaged("the summary does not begin where it can")
    file.seek(data_end)
    opcode, length, data_crc = _DATA_END.unpack(file.read(_DATA_END.size))
    if (opcode, length) != (Opcode.DATA_END, records.DATA_END_BYTES):
        raise Damaged("the data do not end before the summary")
    summary = file.read(size - start)
    # It covers all but itself and the magic behind it.
    if zlib.crc32(memoryview(summary)[:-12]) != crc:
        raise Damaged("the summary's checksum is wrong")
    return data_end, summary, data_crc


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
        rows = np.flatnonzero(block.end - block.start <= records.MESSAGE_BYTES)
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
