"""Reads the index at the end of a finished capture of bilprov, in place of walking its data.

What does not fit means that there is no index: the summary's checksum, the order and the places of
its chunks, its channels. Its counts and times are believed, since its checksum is right.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BufferedReader
from struct import Struct
from struct import error as StructError
from typing import Final

from bilprov.captures import topics
from bilprov.captures.storage import records
from bilprov.captures.storage.messages import Contents
from bilprov.captures.storage.records import MAGIC, RECORD_HEAD, Damaged, Statistics
from bilprov.captures.storage.recovery import RecordFile, read_footer

SUMMARY_BYTES: Final = 64 * 1024 * 1024  # enough for half a million chunks

_READ: Final = 1024 * 1024  # bytes at once, for a checksum
_CHUNK_INDEX: Final = 0x08
_PASSED: Final = {records.SCHEMA, 0x0A, 0x0D, 0x0E}  # indexes of attachments and metadata, offsets

_DATA_END = Struct("<BQI")  # opcode, length; CRC over all data, 0 for none
_FOOTER = Struct("<BQQQI")  # opcode, length; summary start, summary offset start, CRC
_END = _FOOTER.size + len(MAGIC)
_ENTRY = Struct("<BQQQQQI")  # opcode, length; times, offset and length of the chunk; map's length
_MAP_ITEM = Struct("<H8x")  # a channel that the chunk has messages of, and where their index is


@dataclass(frozen=True, slots=True)
class Index:
    """The contents of a file as its index tells them, without bytes by topic; and its chunks.

    `data_end` is the offset after the last chunk and attachment; `data_crc` is the checksum of all
    before, 0 if there is none.
    """

    contents: Contents
    data_end: int
    data_crc: int
    summary: bytes = field(repr=False)
    entries: list[int] = field(repr=False)  # the offset of each chunk's entry in the summary

    def covers(self, file: BufferedReader) -> bool:
        """Whether the checksum over all data, which older kits did not write, is right."""
        file.seek(0)
        crc, left = 0, self.data_end
        while left and (data := file.read(min(left, _READ))):
            crc = zlib.crc32(data, crc)
            left -= len(data)
        return self.data_crc == crc

    def chunks_before(self, time: int, channel: int) -> Iterator[int]:
        """Yield the offsets of the chunks with messages on `channel` that begin before `time` (ns).

        The last one in the file comes first.
        """
        for at in reversed(self.entries):
            _, length, first, _, offset, _, map_length = _ENTRY.unpack_from(self.summary, at)
            start = at + _ENTRY.size
            if first >= time or start + map_length > at + RECORD_HEAD.size + length:
                continue
            if map_length % 10 == 0 and channel in {
                of for (of,) in _MAP_ITEM.iter_unpack(self.summary[start : start + map_length])
            }:
                yield offset


def read_index(file: BufferedReader, size: int) -> Index | None:
    """Read the index of an open file of `size` bytes, whose magic at the start was checked before.

    None if the file is foreign or unfinished, has no index, or has one that does not fit.
    """
    try:
        return _read_index(file, size)
    except (Damaged, StructError):
        return None


def _read_index(file: BufferedReader, size: int) -> Index:
    library, metadata, data_start = _front(file, size)
    summary_start, summary, data_crc = _end(file, size)
    stated: Statistics | None = None
    channels: list[records.ChannelRecord] = []
    entries: list[int] = []
    data_end = summary_start - _DATA_END.size
    at, end, reached = 0, len(summary) - _END, data_start
    entry = _ENTRY.unpack_from
    while at < end:
        # The footer behind the records makes this front complete for the shortest record too.
        opcode, length, _, _, offset, chunk, _ = entry(summary, at)
        if opcode == _CHUNK_INDEX:
            if offset < reached:
                raise Damaged("a chunk's entry does not fit")
            reached = offset + chunk
            entries.append(at)
        elif opcode == records.CHANNEL:
            if len(channels) >= records.CHANNELS or length > records.RECORD_BYTES:
                raise Damaged("there are too many channels")
            channels.append(records.channel_record(summary[at + 9 : at + 9 + length], own=True))
        elif opcode == records.STATISTICS:
            stated = records.statistics_record(summary[at + 9 : at + 9 + length], own=True)
        elif opcode not in _PASSED:
            raise Damaged("what stands there is no record of a summary")
        at += 9 + length
    known = {topic.channel: (topic.name, topic.encoding) for topic in topics.TOPICS}
    table = {channel.id: (channel.topic, channel.encoding) for channel in channels}
    start = metadata.get(topics.START_KEY)
    if (
        at != end
        or reached > data_end
        or stated is None
        or not table.items() <= known.items()
        or {channel.metadata.get(topics.CHANNEL_START_KEY) for channel in channels} != {start}
    ):
        raise Damaged("the index does not fit")
    contents = Contents(
        size=size,
        regions=((len(MAGIC), size),),
        own=True,
        in_order=True,
        counted=True,
        library=library,
        metadata=metadata,
        starts=() if start is None else (start,),
        channels=table,
        first=stated.first,
        last=stated.last,
        counts={topic: stated.counts.get(channel, 0) for channel, (topic, _) in table.items()},
        sizes={},
        unfinished=False,
        damage=(),
    )
    return Index(contents, data_end, data_crc, summary, entries)


def _front(file: BufferedReader, size: int) -> tuple[str, dict[str, str], int]:
    """The library, the metadata `bilprov`, and the offset behind them. Raises Damaged."""
    source = RecordFile(file, size)
    source.own = True
    header = source.record(len(MAGIC))
    about = source.record(header.end)
    if (header.opcode, about.opcode) != (records.HEADER, records.METADATA):
        raise Damaged("the file does not begin as bilprov's do")
    library = records.header_library(header.content)
    name, metadata = records.metadata_record(about.content)
    if not library.startswith(records.OWN_LIBRARY) or name != topics.METADATA_NAME:
        raise Damaged("the file does not begin as bilprov's do")
    return library, metadata, about.end


def _end(file: BufferedReader, size: int) -> tuple[int, bytes, int]:
    """Where the summary begins, its bytes with the footer and the magic, and the CRC of all data.

    Raises Damaged.
    """
    _, _, start, _, crc = _FOOTER.unpack_from(read_footer(file, size))  # none: StructError
    data_end = start - _DATA_END.size
    if not len(MAGIC) <= data_end <= size - _END or size - data_end > SUMMARY_BYTES:
        raise Damaged("the summary does not begin where it can")
    file.seek(data_end)
    content = file.read(size - data_end)
    covered = memoryview(content)[_DATA_END.size : 4 - _END + 21]
    kind, size_of_it, data_crc = _DATA_END.unpack_from(content)
    if len(content) != size - data_end or (kind, size_of_it) != (
        records.DATA_END,
        records.DATA_END_BYTES,
    ):
        raise Damaged("the data do not end before the summary")
    if zlib.crc32(covered) != crc:
        raise Damaged("the summary's checksum is wrong")
    return start, content[_DATA_END.size :], data_crc
