"""Writes a capture file (MCAP) that stays readable after a kill, a full disk or a lost first chunk.

Written data reaches the operating system at most 0.1 s later. The channel table is stored before
the chunks, in the first chunk (where the chunk's checksum protects it) and at the end.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BufferedWriter
from pathlib import Path
from typing import Final

from mcap.records import Channel, Schema

from bilprov.captures import topics
from bilprov.captures.chunked_file import MESSAGE_FRONT, ChunkedFile
from bilprov.captures.closing import Closing
from bilprov.captures.errors import CaptureError
from bilprov.captures.schemas import Chunk, Log, Time
from bilprov.captures.storage.records import ATTACHMENT_BYTES, MESSAGE_BYTES, STRING_BYTES
from bilprov.captures.text import printable

FLUSH_AFTER = 100_000_000  # ns
CHUNK_MESSAGES = 2_000  # the cost of a seek is proportional to this
CHUNK_BYTES = 256 * 1024
U64 = 1 << 64
NEVER: Final = 1 << 65  # ns, later than any time
FULL = {errno.ENOSPC, errno.EFBIG, errno.EDQUOT}


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
        self._failure = ""
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
        self._kept_bytes = self._chunk_messages = self._chunk_bytes = 0
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

    @property
    def failed(self) -> bool:
        """Whether the file could not be written; then nothing more is."""
        return bool(self._failure)

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
        topic = topics.topic_of(value)
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
        self._kept_bytes = self._mcap.size

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
        self._kept_bytes = self._mcap.size
        self._kept_until = self._newest
        self._flush_at = NEVER
        self._chunk_messages = self._chunk_bytes = 0

    @property
    def size(self) -> int:
        """How many bytes of the file have been written, in complete chunks."""
        return self._kept_bytes

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
        self._mcap = ChunkedFile(self._file, f"bilprov {self._version}")
        self._mcap.metadata(topics.METADATA_NAME, about)
        # A flipped bit in the metadata record is not detected, and would shift all times: the
        # start is in the channels too, which a chunk's checksum protects.
        guarded = {topics.CHANNEL_START_KEY: about[topics.START_KEY]}
        schemas: list[Schema] = []
        channels: list[Channel] = []
        for topic in topics.TOPICS:
            if topic.schema:
                form = topics.json_schema(self._shapes.get(topic.value, topic.value))
                schemas.append(Schema(len(schemas) + 1, form, "jsonschema", topic.schema))
            schema = len(schemas) if topic.schema else 0
            channels.append(Channel(topic.channel, topic.name, topic.encoding, guarded, schema))
        self._mcap.table(schemas, channels)
        self._file.flush()
        self._kept_bytes = self._mcap.size

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
        if (
            self._newest >= self._flush_at
            or self._chunk_messages >= CHUNK_MESSAGES
            or self._chunk_bytes > CHUNK_BYTES
        ):
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
        if stat.S_ISREG(status.st_mode) and status.st_size != self._kept_bytes:
            self._fail(
                f"another program made the capture file {printable(self.path)} {status.st_size} "
                f"bytes long while recording, it should have {self._kept_bytes}: what it cut off "
                "is lost, record again"
            )

    def _log_time(self, t: int) -> int:
        log_time = self._start + t
        if not 0 <= log_time < U64:
            raise ValueError(f"log time is {log_time} ns, allowed are 0 to {U64 - 1}")
        return log_time

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        if self._failure:
            raise CaptureError(self._failure)
        if self._closed:
            raise ValueError(f"the capture {printable(self.path)} is closed")
        try:
            yield
        except OSError as error:
            why = "disk full" if error.errno in FULL else printable(error.strerror or error)
            name = printable(self.path)
            if not self._kept_bytes:
                self._fail(f"{why}: {name} cannot be begun", error)
            self._fail(f"{why}: {self._kept()} in {name}{self._before}", error)

    def _kept(self) -> str:
        return f"what was captured until {self._kept_until / 1e9:.1f} s is kept"

    def _fail(self, sentence: str, cause: OSError | None = None) -> None:
        self._failure = sentence
        self._closed = True
        # Closing the raw file discards the buffered data that cannot be written; truncating the
        # half-written chunk leaves complete records only.
        with suppress(OSError):
            if self._file.closed:  # a file system may report only then that it lost something
                raise CaptureError(sentence) from cause
            if os.fstat(self._file.fileno()).st_size > self._kept_bytes:
                os.ftruncate(self._file.fileno(), self._kept_bytes)
        with suppress(OSError):
            self._file.raw.close()
        raise CaptureError(sentence) from cause


def _utf8(text: str) -> str:
    # A port's path may hold bytes that are no UTF-8, which Python carries as lone surrogates.
    return text.encode("utf-8", "backslashreplace").decode()


def _new_file(path: Path) -> BufferedWriter:
    if str(path) == "-":
        raise CaptureError("a capture cannot be written to standard output: name a file")
    try:
        return path.open("xb")
    except FileExistsError as error:
        raise CaptureError(
            f"{printable(path)} exists and captures are never overwritten: choose another name"
        ) from error
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise CaptureError(
            f"{printable(path)} cannot be made ({printable(why)}): choose a "
            "folder that can be written to"
        ) from error
