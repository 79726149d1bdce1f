"""Writes the records of an MCAP file: chunks of messages with their indexes, and the summary.

It stands for the library's writer, whose objects for each message cost more than all the rest of
recording; the records that are written once in a while are the library's own.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator
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
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._messages: list[tuple[int, int, int, bytes]] = []
        self._chunk_front = b""
        self._pack = zstandard.ZstdCompressor().compress
        self._counts: Counter[int] = Counter()
        self._first: int | None = None
        self._last = 0
        self._chunks = 0
        self._indexes: dict[Opcode, RecordBuilder] = {
            kind: RecordBuilder()
            for kind in (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)
        }
        self._attachments = 0
        self._metadata = 0
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
        self._schemas, self._channels = schemas, channels
        self._chunk_front = _bytes(*schemas, *channels)
        self._write(self._chunk_front)

    def metadata(self, name: str, pairs: dict[str, str]) -> None:
        """Write a metadata record, outside of the chunks."""
        at, record = self.size, _bytes(Metadata(name=name, metadata=pairs))
        self._write(record)
        MetadataIndex(offset=at, length=len(record), name=name).write(
            self._indexes[Opcode.METADATA_INDEX]
        )
        self._metadata += 1

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
        self._attachments += 1

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
        self._write_chunk(content, min(times), max(times), places)

    def flush(self) -> None:
        """Pass the written data to the operating system."""
        self._file.flush()

    def finish(self) -> None:
        """Write the end of the data, with a checksum of them all, and the summary with indexes."""
        self.end_chunk()
        self._write(_bytes(DataEnd(self._crc)))
        start = self.size
        summary = b""
        offsets = []
        for kind, group in self._summary():
            if group:
                at = start + len(summary)
                offsets.append(
                    SummaryOffset(group_opcode=kind, group_start=at, group_length=len(group))
                )
                summary += group
        at = start + len(summary)
        summary += _bytes(*offsets)
        crc = zlib.crc32(pack("<BQQQ", Opcode.FOOTER, 20, start, at), zlib.crc32(summary))
        footer = Footer(summary_start=start, summary_offset_start=at, summary_crc=crc)
        self._write(summary + _bytes(footer) + MAGIC)

    def _summary(self) -> Iterator[tuple[Opcode, bytes]]:
        """The groups of the summary, each with its opcode."""
        statistics = Statistics(
            attachment_count=self._attachments,
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=self._chunks,
            message_count=self._counts.total(),
            message_end_time=self._last,
            message_start_time=self._first or 0,
            metadata_count=self._metadata,
            schema_count=len(self._schemas),
        )
        yield Opcode.SCHEMA, _bytes(*self._schemas)
        yield Opcode.CHANNEL, _bytes(*self._channels)
        yield Opcode.STATISTICS, _bytes(statistics)
        for kind, index in self._indexes.items():
            yield kind, index.end()  # type: ignore[no-untyped-call]

    def _write_chunk(
        self, content: bytes, first: int, last: int, places: dict[int, list[int]]
    ) -> None:
        """Write a chunk and, by channel, the times and places of its messages in turn."""
        packed = self._pack(content)
        about: dict[str, Any] = {"compression": "zstd", "uncompressed_size": len(content)}
        about |= {"message_start_time": first, "message_end_time": last}
        record = _bytes(Chunk(data=packed, uncompressed_crc=zlib.crc32(content), **about))
        at = self.size
        offsets = {}
        parts = [record]
        end = at + len(record)
        for channel, pairs in places.items():
            size = 8 * len(pairs)
            offsets[channel] = end
            front = (Opcode.MESSAGE_INDEX, size + 6, channel, size)
            parts.append(pack(f"<BQHI{len(pairs)}Q", *front, *pairs))
            end += len(parts[-1])
            self._counts[channel] += len(pairs) // 2
        self._first = first if self._first is None else min(self._first, first)
        self._last = max(self._last, last)
        self._chunks += 1
        self._write(b"".join(parts))
        ChunkIndex(
            chunk_length=len(record),
            chunk_start_offset=at,
            compressed_size=len(packed),
            message_index_length=end - at - len(record),
            message_index_offsets=offsets,
            **about,
        ).write(self._indexes[Opcode.CHUNK_INDEX])

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
