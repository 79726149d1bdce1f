"""Reads complete records from a file that may be damaged, and finds the next intact chunk."""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Collection, Iterator, Sequence
from io import BufferedReader
from typing import Any, Final, NamedTuple, TypeAlias

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema, Statistics
from numpy.typing import NDArray

from bilprov.captures.storage import records
from bilprov.captures.storage.blocks import message_starts
from bilprov.captures.storage.records import CHUNK_BYTES, CutOff, Damaged

SKIPPED: Final = -1
"""Opcode of a record that was skipped because it is larger than allowed."""

UNPACKED_FREE: Final = 2 * CHUNK_BYTES
UNPACKED_SHARE: Final = 1024
"""All chunks of a file may unpack to UNPACKED_FREE bytes and this many times the file's size."""

HEAD_ROOM: Final = 64  # bytes before a chunk's packed data, more than enough
WINDOW: Final = 1024 * 1024

# The front of a chunk record: opcode, length below 32 MiB, times, size below 32 MiB, CRC,
# one of the compressions.
CHUNK_FRONT = re.compile(
    rb"\x06.{3}[\x00\x01]\x00{4}.{16}.{3}[\x00\x01]\x00{4}.{4}"
    rb"(?:\x04\x00{3}zstd|\x03\x00{3}lz4|\x00{4})",
    re.DOTALL,
)

ATTACHED: Final = records.ATTACHMENT_BYTES + 1024
"""Largest size in bytes of an attachment record, its names included."""

_CHUNK = struct.Struct("<16xQII")  # times; size, CRC, length of the compression's name
_U64 = struct.Struct("<Q")
_INDEX_FRONT = struct.Struct("<BQHI")  # opcode, length, channel, bytes of the entries
_STATED: Final = 46 + 10 * (1 << 16)  # bytes of statistics that count the messages of all channels
INDEX_RECORDS = {0x08, 0x0A, Opcode.STATISTICS, 0x0D, 0x0E, Opcode.FOOTER}


class _Fields(ReadDataStream):
    """The content of a record, whose fields end no earlier than the record says."""

    strings = 0

    def read(self, length: int) -> bytes:
        # A stated length may be more than can be asked for.
        data: bytes = super().read(min(length, ATTACHED))
        if len(data) < length:
            raise EndOfFile
        return data

    def read_prefixed_string(self) -> str:
        """Read the next string; invalid UTF-8 becomes escapes."""
        length = self.read4()
        self.strings += 1
        if self.strings > records.STRINGS:
            raise Damaged(f"a record has more than the {records.STRINGS} strings allowed")
        if length > records.STRING_BYTES:
            raise Damaged(f"a string is {length} bytes, allowed are {records.STRING_BYTES}")
        return self.read(length).decode("utf-8", "backslashreplace")


class _Entries:
    """A message index, of which nobody needs each entry: a hostile file has millions of them."""

    @staticmethod
    def read(fields: _Fields) -> None:
        """Raise Damaged if there is half an entry."""
        fields.read2()
        if len(fields.read(fields.read4())) % 16:
            raise Damaged("a message index has half an entry")


_PARSED: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.STATISTICS: Statistics,
    Opcode.SCHEMA: Schema,
    Opcode.MESSAGE_INDEX: _Entries,
}


def parsed(opcode: int, content: bytes, own: bool) -> Any:
    """Parse one of the records of `_PARSED`; its texts are as stored. Raises Damaged.

    An attachment has a checksum; one of 0 is none, which is accepted unless it is our `own`.
    """
    if opcode == Opcode.STATISTICS and len(content) > _STATED:
        raise Damaged("statistics count the messages of more channels than there can be")
    fields = _Fields(io.BytesIO(content))
    try:
        record = _PARSED[opcode].read(fields)
    except EndOfFile as error:
        raise Damaged("a record is shorter than its fields") from error
    # The format lets other writers append fields; our writer does not.
    if own and fields.count != len(content):
        raise Damaged("a record is longer than its fields")
    if opcode == Opcode.ATTACHMENT:
        end = fields.count - 4
        crc = int.from_bytes(content[end : end + 4], "little")
        if (crc or own) and crc != zlib.crc32(memoryview(content)[:end]):
            raise Damaged("the checksum (CRC) of an attachment is wrong")
    return record


NOTHING: Final = np.zeros(0, np.int64)
ONE: Final = np.zeros(1, np.int64)


class Found(NamedTuple):
    """A complete record: its opcode, the offset of its end, and what it holds.

    That is the `content` of a chunk (unpacked) or a message, or the `record` of another one that is
    parsed. `verified` is true if a checksum covers the content; `note` says why a record was
    skipped. Of a chunk that `walk` gives, `starts` are where its messages begin, `channels` the
    channels that it describes, and its end is behind its message indexes.
    """

    opcode: int
    end: int
    content: bytes = b""
    verified: bool = False
    note: str = ""
    starts: NDArray[np.int64] = NOTHING
    channels: Sequence[Channel] = ()
    record: Any = None


class Lost(NamedTuple):
    """Bytes from `start` to `end` that are damaged; `whole_again` is false if no chunk follows."""

    start: int
    end: int
    damage: Damaged
    whole_again: bool


Walk: TypeAlias = Iterator[Found | Lost]


class RecordFile:
    """An open MCAP file of `size` bytes, from which complete records are read by their offset.

    `own` is true if bilprov wrote the file: then records that bilprov never writes are rejected.
    `past_data` is true after the end of the data: before it, records of an index are rejected.

    What is held of a file at once is bounded, and so is the work, by the file's size. Where a
    hostile file would unpack to more, that is damage, and after it no further chunk is found. No
    capture of a line comes near: its messages take more than 4 bytes each, packed.
    """

    def __init__(self, file: BufferedReader, size: int) -> None:
        self.own = False
        self.past_data = False
        self.size = size
        self._file = file
        # A false chunk front may cost 16 MiB of reading, and a hostile file has millions of them.
        self._patience = 4 * size + 4 * CHUNK_BYTES
        self._unpacked = UNPACKED_FREE + UNPACKED_SHARE * size
        self._zstd = zstandard.ZstdDecompressor(max_window_size=CHUNK_BYTES)

    def record(self, offset: int, only: Collection[int] | None = None) -> Found:
        """Read the record at `offset`, without its content if it is none of `only`.

        Raises Damaged if it is inconsistent, CutOff if the file ends before the record.
        """
        self._file.seek(offset)
        head = self._file.read(records.RECORD_HEAD.size)
        if len(head) < records.RECORD_HEAD.size:
            raise CutOff("the file ends inside a record")
        opcode, length = records.RECORD_HEAD.unpack(head)
        end = offset + records.RECORD_HEAD.size + length
        if end > self.size:
            raise CutOff("a record ends after the file")
        if only is not None and opcode not in only:
            return Found(opcode, end)
        if opcode == Opcode.CHUNK:
            return self._chunk(offset, length, end)
        if opcode == Opcode.MESSAGE:
            return self._message(length, end)
        return self._other(opcode, length, end, bool(only))

    def walk(self, start: int, end: int, only: Collection[int] | None = None) -> Walk:
        """Yield the records that begin from `start` up to `end`, up to and with a footer.

        What is damaged is left out up to the next intact chunk. With `only`, other records than
        these are passed without their content.
        """
        offset = start
        while offset < end:
            try:
                found = self.record(offset, only)
                if found.opcode == Opcode.CHUNK and (only is None or Opcode.CHUNK in only):
                    found = self._examined(found)
            except Damaged as damage:
                at = self.next_chunk(offset + 1)
                yield Lost(offset, self.size if at is None else at, damage, at is not None)
                offset = self.size if at is None else at
                continue
            offset = found.end
            if found.opcode == Opcode.DATA_END:
                self.past_data = True
            yield found
            if found.opcode == Opcode.FOOTER:
                return

    def _examined(self, chunk: Found) -> Found:
        """The chunk with what is in it. Raises Damaged if it is inconsistent."""
        content = chunk.content
        if not content:
            return chunk
        index, end = self._index(chunk.end, len(content))
        starts, others = message_starts(content, index)
        channels = [
            parsed(opcode, content[start:stop], own=False)
            for opcode, start, stop in others
            if opcode == Opcode.CHANNEL
        ]
        return Found(Opcode.CHUNK, end, content, chunk.verified, "", starts, channels)

    def _index(self, offset: int, most: int) -> tuple[bytes, int]:
        """The entries of the message indexes that stand at `offset`, and where these end."""
        entries = []
        self._file.seek(offset)
        while len(head := self._file.read(_INDEX_FRONT.size)) == _INDEX_FRONT.size:
            opcode, length, _, size = _INDEX_FRONT.unpack(head)
            if opcode != Opcode.MESSAGE_INDEX or size + 6 != length or size > most:
                break
            entry = self._file.read(size)
            if size % 16 or len(entry) < size:
                break
            entries.append(entry)
            offset += _INDEX_FRONT.size + size
        return b"".join(entries), offset

    def next_chunk(self, offset: int, until: int | None = None) -> int | None:
        """Find the start of the next chunk with a correct checksum, at `offset` or later, or None.

        It is looked for up to `until`, which is rounded up to whole windows. A foreign chunk
        without a checksum counts if it is compressed and unpacks to exactly the size it declares.
        """
        end = self.size if until is None else min(until, self.size)
        while offset < end and self._patience > 0:
            self._file.seek(offset)
            window = self._file.read(WINDOW + HEAD_ROOM)
            at = 0
            while match := CHUNK_FRONT.search(window, at):
                at = match.start() + 1
                if at > WINDOW:
                    break
                compressed = match.group()[-1] != 0
                if self._is_chunk(offset + match.start(), compressed):
                    return offset + match.start()
                if self._patience <= 0:
                    return None
            self._patience -= len(window)
            offset += WINDOW
        return None

    def _is_chunk(self, offset: int, compressed: bool) -> bool:
        try:
            found = self.record(offset)
        except Damaged:
            return False
        finally:
            self._patience -= max(self._file.tell() - offset, HEAD_ROOM)
        return found.opcode == Opcode.CHUNK and (found.verified or compressed)

    def _chunk(self, offset: int, length: int, end: int) -> Found:
        front = self._content(min(length, HEAD_ROOM))
        try:
            size, crc, name = _CHUNK.unpack_from(front)
            start = _CHUNK.size + name + _U64.size
            (packed,) = _U64.unpack_from(front, start - _U64.size)
        except struct.error as error:
            raise Damaged("a record is shorter than its fields") from error
        if start + packed != length:
            raise Damaged("a chunk's length does not fit its content")
        if max(size, packed) > CHUNK_BYTES:
            if self.own:
                raise Damaged(f"a chunk is larger than the {CHUNK_BYTES} bytes allowed")
            note = f"the chunk at byte {offset} holds {size} bytes, allowed are {CHUNK_BYTES}"
            return Found(SKIPPED, end, note=f"{note}: left out")
        self._unpacked -= size
        if self._unpacked < 0:
            self._patience = 0
            free = UNPACKED_FREE >> 20
            raise Damaged(f"it unpacks to more than {free} MiB and {UNPACKED_SHARE} x its size")
        content = front + self._content(length - len(front))
        compression = content[_CHUNK.size : _CHUNK.size + name]
        data = self._unpack(memoryview(content)[start:], compression, size)
        if len(data) != size:
            raise Damaged("a chunk does not unpack to the size that it declares")
        # A CRC of 0 means that there is none, which is accepted from foreign writers only.
        verified = crc != 0 or self.own
        if verified and zlib.crc32(data) != crc:
            raise Damaged("a chunk's checksum is wrong")
        return Found(Opcode.CHUNK, end, data, verified)

    def _unpack(self, packed: memoryview, compression: bytes, size: int) -> bytes:
        """Unpack a chunk; gives at most one byte more than its size. Raises Damaged."""
        try:
            if compression == b"zstd":
                if zstandard.frame_content_size(packed) == size:  # so much is allocated
                    return self._zstd.decompress(packed, allow_extra_data=False)
                # What the frame declares is not to be allocated: unpacked piece by piece.
                source = io.BytesIO(packed)
                with self._zstd.stream_reader(source, read_across_frames=True) as reader:
                    return reader.read(size + 1)
            if compression == b"lz4":
                decompressor = lz4.frame.LZ4FrameDecompressor()
                return bytes(decompressor.decompress(packed, max_length=size + 1))
        except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
            raise Damaged(f"a chunk cannot be unpacked with {compression.decode()}") from error
        if compression == b"":
            return bytes(packed)
        raise Damaged("a chunk is compressed with something other than zstd and lz4")

    def _message(self, length: int, end: int) -> Found:
        if self.own:
            raise Damaged("a message stands outside of the chunks")
        if length < records.MESSAGE_HEAD.size:
            raise Damaged("a message is shorter than its fields")
        if length - records.MESSAGE_HEAD.size > records.MESSAGE_BYTES:
            note = f"a message holds {length} bytes, allowed are {records.MESSAGE_BYTES}: left out"
            return Found(SKIPPED, end, note=note)
        content = records.RECORD_HEAD.pack(Opcode.MESSAGE, length) + self._content(length)
        return Found(Opcode.MESSAGE, end, content, starts=ONE)

    def _other(self, opcode: int, length: int, end: int, only: bool) -> Found:
        if opcode == Opcode.FOOTER and end + len(records.MAGIC) > self.size:
            raise CutOff("the file ends before its last 8 bytes")
        if opcode == Opcode.FOOTER and (
            length != records.FOOTER_BYTES or end + len(records.MAGIC) != self.size
        ):
            raise Damaged("a footer stands before the end")
        if opcode in INDEX_RECORDS and not self.past_data:
            raise Damaged("a record of the index stands before the end of the data")
        # Foreign attachments are read only where they are asked for.
        if opcode in _PARSED and (self.own or only or opcode != Opcode.ATTACHMENT):
            most = ATTACHED if opcode == Opcode.ATTACHMENT else records.RECORD_BYTES
            if length > most:
                raise Damaged(f"a record is larger than the {most} bytes allowed")
            return Found(opcode, end, record=parsed(opcode, self._content(length), self.own))
        if opcode == Opcode.DATA_END and length != records.DATA_END_BYTES:
            raise Damaged("the end of the data is not as long as it should be")
        if opcode == 0 or (self.own and opcode > Opcode.DATA_END):
            raise Damaged("what stands there is no record")
        return Found(opcode, end)

    def _content(self, length: int) -> bytes:
        content = self._file.read(length)
        if len(content) < length:
            raise CutOff("the file ends inside a record")
        return content


def read_footer(file: BufferedReader, size: int) -> bytes:
    """The footer of a file and the magic behind it; b"" if the file is not finished."""
    begin = records.RECORD_HEAD.pack(Opcode.FOOTER, records.FOOTER_BYTES)
    tail = len(begin) + records.FOOTER_BYTES + len(records.MAGIC)
    file.seek(max(0, size - tail))
    last = file.read(tail)
    whole = last.startswith(begin) and last.endswith(records.MAGIC)
    return last if whole and size >= len(records.MAGIC) + tail else b""
