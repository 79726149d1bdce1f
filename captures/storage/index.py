"""What a capture file holds, and how its index at the end tells it without a walk over its data.

What does not fit means that there is no index: the summary's checksum, the order and the places of
its chunks, its channels. Its counts and times are believed, since its checksum is right.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from io import BufferedReader
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Header, Metadata

from bilprov.captures import topics
from bilprov.captures.storage.records import DATA_END_BYTES, MAGIC, OWN_LIBRARY, Damaged
from bilprov.captures.storage.recovery import RecordFile, parsed, read_footer
from bilprov.captures.text import printable
from bilprov.captures.wall_clock import stated_number

SUMMARY_BYTES: Final = 64 * 1024 * 1024  # enough for half a million chunks

_READ: Final = 1024 * 1024  # bytes at once, for a checksum
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
        while left and (data := file.read(min(left, _READ))):
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
            library.startswith(OWN_LIBRARY)
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
            if (
                table[channel.id] != known.get(channel.id)
                or channel.metadata.get(topics.CHANNEL_START_KEY) != start
            ):
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
    if (opcode, length) != (Opcode.DATA_END, DATA_END_BYTES):
        raise Damaged("the data do not end before the summary")
    summary = file.read(size - start)
    # It covers all but itself and the magic behind it.
    if zlib.crc32(memoryview(summary)[:-12]) != crc:
        raise Damaged("the summary's checksum is wrong")
    return data_end, summary, data_crc
