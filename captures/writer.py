"""Writes a capture file (MCAP) that stays readable after a kill, a full disk or a lost first chunk.

Written data reaches the operating system at most 0.1 s later. The channel table is stored before
the chunks, in the first chunk (where the chunk's checksum protects it) and at the end.
"""

from __future__ import annotations

import errno
import os
import stat
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BufferedWriter
from pathlib import Path
from struct import Struct, pack
from typing import Any, Final

import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from bilprov.captures import topics
from bilprov.captures.closing import Closing
from bilprov.captures.errors import CaptureError
from bilprov.captures.parts import require_new
from bilprov.captures.schemas import Chunk, Log, Time
from bilprov.captures.storage.records import ATTACHMENT_BYTES, MAGIC, MESSAGE_BYTES, STRING_BYTES
from bilprov.captures.text import printable

FLUSH_AFTER = 100_000_000  # ns
CHUNK_MESSAGES = 2_000  # the cost of a seek is proportional to this
CHUNK_BYTES = 256 * 1024
U64 = 1 << 64
NEVER: Final = 1 << 65  # ns, later than any time
FULL = {errno.ENOSPC, errno.EFBIG, errno.EDQUOT}
MESSAGE_FRONT: Final = 31  # bytes of a message record before its data

_MESSAGE = Struct("<BQHIQQ")  # opcode, length; channel, sequence, log time, publish time


class CaptureWriter(Closing):
    """Writes one new capture file; a context manager, for one thread.

    `start_wall` is the wall clock in ns at the capture's start, from which every `t` counts.
    `metadata` becomes the record `bilprov`, to which `start` (= `start_wall`) is added; it is in
    the file before the constructor returns. `version` is the kit's, `state` the class of the states
    that are written.

    Raises CaptureError if the file exists or cannot be created, and later if it cannot be written.
    Raises ValueError for a time that is not in 0 to 2^64 - 1 ns and for metadata over 64 KiB.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        start_wall: int,
        metadata: Mapping[str, str],
        version: str,
        shapes: topics.Shapes = topics.CAR_SHAPES,
    ) -> None:
        self._start = start_wall
        self._log_time(0)
        self._version = version
        self._shapes = shapes
        self._sequence = self._newest = self._kept_until = 0
        self._before = ""  # what else holds a part of the recording
        self.failure = ""
        """Why the file could not be written, after which nothing more is; "" before."""
        self._begin(Path(path), metadata)

    def _begin(self, path: Path, metadata: Mapping[str, str]) -> None:
        about = {_utf8(name): _utf8(text) for name, text in metadata.items()}
        about[topics.START_KEY] = str(self._start)
        for name, text in about.items():
            if max(len(name.encode()), len(text.encode())) > STRING_BYTES:
                raise ValueError(
                    f"metadata {printable(name)} is longer than the {STRING_BYTES} bytes allowed"
                )
        self._file = _new_file(path)
        self.size = 0
        """How many bytes of the file have been written, in complete chunks."""
        self._chunk_messages = self._chunk_bytes = 0
        self._flush_at = NEVER
        self._closed = False
        self.path = path
        # Some file systems do not count links; there a deleted file cannot be noticed.
        self._counts_links = os.fstat(self._file.fileno()).st_nlink > 0
        try:
            with self._guarded():
                self._write_front(about)
        except CaptureError:
            with suppress(OSError):
                path.unlink()  # it holds nothing
            raise

    def chunk(self, chunk: Chunk) -> None:
        """Write a chunk; more than 64 KiB become several messages with the same time.

        Raises CaptureError if the file cannot be written.
        """
        channel = 1 if chunk.direction == "host" else 2
        data = chunk.data
        if len(data) <= MESSAGE_BYTES:
            self._add(channel, data, chunk.t)
            return
        for at in range(0, len(data), MESSAGE_BYTES):
            self._add(channel, data[at : at + MESSAGE_BYTES], chunk.t)

    def write(self, value: topics.Written, t: int) -> None:
        """Write a value on the topic of its type; `t` is ns since the capture's start.

        A value whose JSON is over 64 KiB is left out and reported on `/faults`: a reader would
        refuse it, and it can be decoded again from the raw bytes. Raises CaptureError if the file
        cannot be written.
        """
        topic = topics.topic_of(type(value))
        data = topics.encoded(value)
        if len(data) <= MESSAGE_BYTES:
            self._add(topic.channel, data, t)
            return
        left_out = f"{topic.name}: a message of {len(data)} bytes, allowed are {MESSAGE_BYTES}"
        self.log(t, 3, left_out, "left out")

    def log(self, t: int, level: int, message: str, name: str) -> None:
        """Write on `/faults`, at `t` (ns since the capture's start); the rest as in a Log."""
        moment = Time(*divmod(self._log_time(t), 1_000_000_000))
        self.write(Log(moment, level, message, name), t)

    def attach(self, name: str, media_type: str, data: bytes, t: int) -> None:
        """Attach a file's content at `t` (ns since the capture's start) and flush it.

        Content of more than 64 MiB is left out and reported on `/faults`. Raises CaptureError if
        the file cannot be written.
        """
        log_time = self._log_time(t)
        if len(data) > ATTACHMENT_BYTES:
            left_out = f"{name}: {len(data)} bytes, allowed are {ATTACHMENT_BYTES}"
            self.log(t, 3, left_out, "left out")
            return
        self.flush()
        with self._guarded():
            self._mcap.attachment(name, media_type, data, log_time)
            self._file.flush()
        self.size = self._mcap.size

    def tick(self, now: int) -> None:
        """Flush if data have waited for 0.1 s; `now` is ns since the capture's start.

        Raises CaptureError if the file cannot be written.
        """
        self._newest = max(self._newest, now)
        if self._newest >= self._flush_at:
            self.flush()

    def flush(self) -> None:
        """Pass all data written so far to the operating system.

        Raises CaptureError if the disk is full, the file is gone or cannot be written.
        """
        with self._guarded():
            self._require_unchanged()
            self._mcap.end_chunk()
            self._file.flush()
        self.size = self._mcap.size
        self._kept_until = self._newest
        self._flush_at = NEVER
        self._chunk_messages = self._chunk_bytes = 0

    def go_on_in(self, path: Path, metadata: Mapping[str, str]) -> None:
        """Finish the file, and go on in a new one.

        Times count from the same start and sequence numbers go on. Raises CaptureError if this file
        cannot be finished, or the new one made.
        """
        self.close()
        finished = self.path
        try:
            self._begin(path, metadata)
        except CaptureError as error:
            raise CaptureError(f"{error}; {self._kept()} in {printable(finished)}") from error
        self._before = " and the parts before it"

    def close(self) -> None:
        """Finish the file; further calls, and a call after a failure, do nothing.

        Raises CaptureError if the end cannot be written.
        """
        if self._closed:
            return
        self.flush()
        with self._guarded():
            self._mcap.finish()
            # A buffered file that cannot be flushed is closed all the same when it is closed, and
            # then the half-written end can no longer be cut off.
            self._file.flush()
            self._file.close()
        self._closed = True

    def _write_front(self, about: dict[str, str]) -> None:
        self._mcap = _ChunkedFile(self._file, f"bilprov {self._version}")
        self._mcap.metadata(topics.METADATA_NAME, about)
        # A flipped bit in the metadata record is not detected, and would shift all times: the
        # start is in the channels too, which a chunk's checksum protects.
        guarded = {topics.CHANNEL_START_KEY: about[topics.START_KEY]}
        schemas: list[records.Schema] = []
        channels: list[records.Channel] = []
        for topic in topics.TOPICS:
            if topic.schema:
                form = topics.json_schema(self._shapes.get(topic.value, topic.value))
                schemas.append(records.Schema(len(schemas) + 1, form, "jsonschema", topic.schema))
            of = topic.name, topic.encoding, guarded, len(schemas) if topic.schema else 0
            channels.append(records.Channel(topic.channel, *of))
        self._mcap.table(schemas, channels)
        self._file.flush()
        self.size = self._mcap.size

    def _add(self, channel: int, data: bytes, t: int) -> None:
        # A message costs about a microsecond: nothing here that is not needed for each.
        log_time = self._start + t
        if self._closed or not 0 <= log_time < U64:
            with self._guarded():
                self._log_time(t)
        sequence = self._sequence
        self._sequence = (sequence + 1) & 0xFFFF_FFFF
        self._mcap.message((channel, sequence, log_time, data))
        self._chunk_messages += 1
        self._chunk_bytes += len(data) + MESSAGE_FRONT
        if t > self._newest:
            self._newest = t
        if self._flush_at == NEVER:
            # A message may come late (a frame's `t` is its first byte): it waits from now, not `t`.
            self._flush_at = self._newest + FLUSH_AFTER
        full = self._chunk_messages >= CHUNK_MESSAGES or self._chunk_bytes > CHUNK_BYTES
        if full or self._newest >= self._flush_at:
            self.flush()

    def _require_unchanged(self) -> None:
        """Fail if the file was deleted, or if another program cut it or wrote to it.

        Looked at before a chunk is written: a write behind the end fills what was cut off with
        zeros, after which the size is right again.
        """
        status = os.fstat(self._file.fileno())
        if self._counts_links and status.st_nlink == 0:
            self._fail(
                f"the capture file {printable(self.path)} was deleted while recording: what it "
                "held is lost, record again"
            )
        if stat.S_ISREG(status.st_mode) and status.st_size != self.size:
            self._fail(
                f"another program made the capture file {printable(self.path)} {status.st_size} "
                f"bytes long while recording, it should have {self.size}: what it cut off "
                "is lost, record again"
            )

    def _log_time(self, t: int) -> int:
        log_time = self._start + t
        if not 0 <= log_time < U64:
            raise ValueError(f"log time is {log_time} ns, allowed are 0 to {U64 - 1}")
        return log_time

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        if self.failure:
            raise CaptureError(self.failure)
        if self._closed:
            raise ValueError(f"the capture {printable(self.path)} is closed")
        try:
            yield
        except OSError as error:
            why = "disk full" if error.errno in FULL else printable(error.strerror or error)
            name = printable(self.path)
            if not self.size:
                self._fail(f"{why}: {name} cannot be begun", error)
            self._fail(f"{why}: {self._kept()} in {name}{self._before}", error)

    def _kept(self) -> str:
        return f"what was captured until {self._kept_until / 1e9:.1f} s is kept"

    def _fail(self, sentence: str, cause: OSError | None = None) -> None:
        self.failure = sentence
        self._closed = True
        # Closing the raw file discards the buffered data that cannot be written; truncating the
        # half-written chunk leaves complete records only.
        with suppress(OSError):
            if self._file.closed:  # a file system may report only then that it lost something
                raise CaptureError(sentence) from cause
            if os.fstat(self._file.fileno()).st_size > self.size:
                os.ftruncate(self._file.fileno(), self.size)
        with suppress(OSError):
            self._file.raw.close()
        raise CaptureError(sentence) from cause


def _utf8(text: str) -> str:
    # A port's path may hold bytes that are no UTF-8, which Python carries as lone surrogates.
    return text.encode("utf-8", "backslashreplace").decode()


def _new_file(path: Path) -> BufferedWriter:
    require_new(path)
    try:
        return path.open("xb")
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise CaptureError(
            f"{printable(path)} cannot be made ({printable(why)}): choose a "
            "folder that can be written to"
        ) from error


class _ChunkedFile:
    """A new MCAP file without data yet; it is only ever appended to.

    It stands for the library's writer, whose objects for each message cost more than all the rest
    of recording; the records that are written once in a while are the library's own. Every
    method that writes raises OSError.
    """

    # Measured: 1.9 us for each message against the library's 8.6 to 9.7; whole recordings are made
    # at 160 k against 91 k frames/s, or at 484 k against 291 k.
    def __init__(self, file: BufferedWriter, library: str) -> None:
        self.size = 0
        """The number of bytes written."""
        self._file = file
        self._crc = 0  # of all that is written
        self._table: dict[Opcode, bytes] = {}
        self._messages: list[tuple[int, int, int, bytes]] = []
        self._chunk_front = b""
        self._pack = zstandard.ZstdCompressor().compress
        self._stated = records.Statistics(0, 0, Counter(), *[0] * 6)  # of nothing
        self._indexes: dict[Opcode, RecordBuilder] = {
            kind: RecordBuilder()
            for kind in (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)
        }
        self.message = self._messages.append
        """Add a message: its channel, sequence (32 bits), log time (ns, 64 bits) and data.

        It is written with the chunk that `end_chunk` writes.
        """
        self._write(MAGIC + _bytes(records.Header("", library)))

    def table(self, schemas: list[records.Schema], channels: list[records.Channel]) -> None:
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
        at, record = self.size, _bytes(records.Metadata(name=name, metadata=pairs))
        self._write(record)
        index = records.MetadataIndex(offset=at, length=len(record), name=name)
        index.write(self._indexes[Opcode.METADATA_INDEX])
        self._stated.metadata_count += 1

    def attachment(self, name: str, media_type: str, data: bytes, log_time: int) -> None:
        """Write an attachment, outside of the chunks."""
        at = self.size
        about: dict[str, Any] = {"name": name, "media_type": media_type}
        about |= {"create_time": log_time, "log_time": log_time}
        record = _bytes(records.Attachment(data=data, **about))
        self._write(record)
        records.AttachmentIndex(offset=at, length=len(record), data_size=len(data), **about).write(
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
        record = _bytes(records.Chunk(data=packed, uncompressed_crc=zlib.crc32(content), **about))
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
        records.ChunkIndex(
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
        self._write(_bytes(records.DataEnd(self._crc)))
        start = self.size
        groups = {**self._table, Opcode.STATISTICS: _bytes(self._stated)}
        for kind, index in self._indexes.items():
            groups[kind] = index.end()  # type: ignore[no-untyped-call]
        summary = b""
        offsets = []
        for kind, group in groups.items():
            if group:
                offsets.append(records.SummaryOffset(kind, start + len(summary), len(group)))
                summary += group
        at = start + len(summary)
        summary += _bytes(*offsets)
        crc = zlib.crc32(pack("<BQQQ", Opcode.FOOTER, 20, start, at), zlib.crc32(summary))
        footer = records.Footer(summary_start=start, summary_offset_start=at, summary_crc=crc)
        self._write(summary + _bytes(footer) + MAGIC)

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._file.write(data)
        self.size += len(data)


def _bytes(*written: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in written:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
