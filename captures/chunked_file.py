"""Writes the records of an MCAP file: chunks of messages with their indexes, and the summary.

It stands for the library's writer, whose objects for each message cost more than all the rest of
recording; the records that are written once in a while are the library's own.
"""

from __future__ import annotations

import zlib
from collections import Counter
from io import BufferedWriter
from struct import Struct, pack
from typing import Any, Final

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC: Final = b"\x89MCAP0\r\n"
MESSAGE_FRONT: Final = 31  # bytes of a message record before its data

_MESSAGE = Struct("<BQHIQQ")  # opcode, length; channel, sequence, log time, publish time


class ChunkedFile:
    """A new MCAP file without data yet; it is only ever appended to.

    Every method that writes raises OSError.
    """

    def __init__(self, file: BufferedWriter, library: str) -> None:
        self.size = 0
        """The number of bytes written."""
        self._file = file
        self._crc = 0  # of all that is written
        self._table: dict[Opcode, bytes] = {}
        self._messages: list[tuple[int, int, int, bytes]] = []
        self._chunk_front = b""
        self._pack = zstandard.ZstdCompressor().compress
        self._stated = Statistics(0, 0, Counter(), *[0] * 6)  # of nothing
        self._indexes: dict[Opcode, RecordBuilder] = {
            kind: RecordBuilder()
            for kind in (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)
        }
        self.message = self._messages.append
        """Add a message: its channel, sequence (32 bits), log time (ns, 64 bits) and data.

        It is written with the chunk that `end_chunk` writes.
        """
        self._write(MAGIC + _bytes(Header("", library)))

    def table(self, schemas: list[Schema], channels: list[Channel]) -> None:
        """Write schemas and channels; they come again in the first chunk and in the summary.

        The copy before the chunks lets the streaming readers of other programs work when the first
        chunk is lost or was never written.
        """
        self._stated.schema_count, self._stated.channel_count = len(schemas), len(channels)
        self._table = {Opcode.SCHEMA: _bytes(*schemas), Opcode.CHANNEL: _bytes(*channels)}
        self._chunk_front = b"".join(self._table.values())
        self._write(self._chunk_front)

    def metadata(self, name: str, pairs: dict[str, str]) -> None:
        """Write a metadata record, outside of the chunks."""
        at, record = self.size, _bytes(Metadata(name=name, metadata=pairs))
        self._write(record)
        MetadataIndex(offset=at, length=len(record), name=name).write(
            self._indexes[Opcode.METADATA_INDEX]
        )
        self._stated.metadata_count += 1

    def attachment(self, name: str, media_type: str, data: bytes, log_time: int) -> None:
        """Write an attachment, outside of the chunks."""
        at = self.size
        about: dict[str, Any] = {"name": name, "media_type": media_type}
        about |= {"create_time": log_time, "log_time": log_time}
        record = _bytes(Attachment(data=data, **about))
        self._write(record)
        AttachmentIndex(offset=at, length=len(record), data_size=len(data), **about).write(
            self._indexes[Opcode.ATTACHMENT_INDEX]
        )
        self._stated.attachment_count += 1

    def end_chunk(self) -> None:
        """Write the messages added since the last chunk as one; without any, nothing."""
        messages = self._messages
        if not messages:
            return
        at = len(self._chunk_front)
        parts = [self._chunk_front]
        places: dict[int, list[int]] = {}
        head = _MESSAGE.pack
        for channel, sequence, log_time, data in messages:
            size = len(data)
            parts += head(5, size + 22, channel, sequence, log_time, log_time), data
            if channel in places:
                places[channel] += log_time, at
            else:
                places[channel] = [log_time, at]
            at += size + MESSAGE_FRONT
        content = b"".join(parts)
        times = [message[2] for message in messages]
        # Cleared before anything is written: what cannot be written is not tried again.
        messages.clear()
        self._chunk_front = b""
        packed = self._pack(content)
        first, last = min(times), max(times)
        about: dict[str, Any] = {"compression": "zstd", "uncompressed_size": len(content)}
        about |= {"message_start_time": first, "message_end_time": last}
        record = _bytes(Chunk(data=packed, uncompressed_crc=zlib.crc32(content), **about))
        offsets = {}
        parts = [record]
        start, end = self.size, self.size + len(record)
        stated = self._stated
        for channel, pairs in places.items():
            size = 8 * len(pairs)
            offsets[channel] = end
            front = (Opcode.MESSAGE_INDEX, size + 6, channel, size)
            parts.append(pack(f"<BQHI{len(pairs)}Q", *front, *pairs))
            end += len(parts[-1])
            stated.channel_message_counts[channel] += len(pairs) // 2
        stated.message_count += len(times)
        started = stated.message_start_time if stated.chunk_count else first
        stated.message_start_time = min(first, started)
        stated.message_end_time = max(last, stated.message_end_time)
        stated.chunk_count += 1
        self._write(b"".join(parts))
        ChunkIndex(
            chunk_length=len(record),
            chunk_start_offset=start,
            compressed_size=len(packed),
            message_index_length=end - start - len(record),
            message_index_offsets=offsets,
            **about,
        ).write(self._indexes[Opcode.CHUNK_INDEX])

    def finish(self) -> None:
        """Write the end of the data, with a checksum of them all, and the summary with indexes."""
        self.end_chunk()
        self._write(_bytes(DataEnd(self._crc)))
        start = self.size
        groups = {**self._table, Opcode.STATISTICS: _bytes(self._stated)}
        for kind, index in self._indexes.items():
            groups[kind] = index.end()  # type: ignore[no-untyped-call]
        summary = b""
        offsets = []
        for kind, group in groups.items():
            if group:
                offsets.append(SummaryOffset(kind, start + len(summary), len(group)))
                summary += group
        at = start + len(summary)
        summary += _bytes(*offsets)
        crc = zlib.crc32(pack("<BQQQ", Opcode.FOOTER, 20, start, at), zlib.crc32(summary))
        footer = Footer(summary_start=start, summary_offset_start=at, summary_crc=crc)
        self._write(summary + _bytes(footer) + MAGIC)

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._file.write(data)
        self.size += len(data)


def _bytes(*written: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in written:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
