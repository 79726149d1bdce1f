"""Parses MCAP records from their byte layouts; raises Damaged for whatever is inconsistent."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import msgspec

from bilprov.captures.text import escape_controls

MAGIC: Final = b"\x89MCAP0\r\n"
OWN_LIBRARY: Final = "bilprov "
"""The prefix of the library's name in our own files."""

HEADER: Final = 0x01
FOOTER: Final = 0x02
SCHEMA: Final = 0x03
CHANNEL: Final = 0x04
MESSAGE: Final = 0x05
CHUNK: Final = 0x06
MESSAGE_INDEX: Final = 0x07
ATTACHMENT: Final = 0x09
STATISTICS: Final = 0x0B
METADATA: Final = 0x0C
DATA_END: Final = 0x0F
LAST_KNOWN: Final = 0x0F

RECORD_HEAD: Final = struct.Struct("<BQ")
MESSAGE_HEAD: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
FOOTER_BYTES: Final = 20
DATA_END_BYTES: Final = 4

# The largest parts that are read; checked before memory is allocated.
CHUNK_BYTES: Final = 16 * 1024 * 1024  # of one chunk, as stored and as unpacked
MESSAGE_BYTES: Final = 64 * 1024  # of data of one message
STRING_BYTES: Final = 64 * 1024  # of one string of a header, a channel or a metadata record
RECORD_BYTES: Final = 16 * 1024 * 1024  # of any other record whose content is read
ATTACHMENT_BYTES: Final = 64 * 1024 * 1024  # of one attachment whose content is read
CHANNELS: Final = 64  # in one file
PAIRS: Final = 4096  # of one map of strings
DESCRIPTIONS: Final = 4096  # records of a chunk that are no messages: schemas and channels

JSON_ERRORS: Final = (msgspec.MsgspecError, ValueError, RecursionError)
"""Exceptions for JSON that cannot be decoded; deep nesting raises RecursionError."""

_CHUNK = struct.Struct("<16xQII")  # times; size, CRC, length of the compression's name
_COUNT = struct.Struct("<HQ")
_NUMBERS = {"H": 2, "I": 4, "Q": 8}  # bytes
_U64 = struct.Struct("<Q")


class Damaged(Exception):
    """A record is inconsistent. The message says what is wrong, but not where."""


class CutOff(Damaged):
    """A record ends after the end of the file, as usual in a capture that was not finished."""


@dataclass(frozen=True, slots=True)
class ChannelRecord:
    """The fields of a channel record."""

    id: int
    topic: str
    encoding: str
    metadata: dict[str, str]


@dataclass(frozen=True, slots=True)
class AttachmentRecord:
    """A file that is attached to a capture; `log_time` in ns."""

    name: str
    media_type: str
    log_time: int
    data: bytes = field(repr=False)


@dataclass(slots=True)
class _Cursor:
    """Reads the little-endian fields of a record in order; raises Damaged if they end early."""

    data: bytes
    at: int = field(default=0)

    def field(self, kind: str) -> Any:
        """Read the next field, of a kind as in `_fields`."""
        if kind in _NUMBERS:
            return int.from_bytes(self.block(_NUMBERS[kind]), "little")
        if kind == "s":
            return self.text()
        if kind == "m":
            return self.texts()
        return self.block(self.field("I" if kind == "b" else "Q"))

    def block(self, length: int) -> bytes:
        """Read the next `length` bytes."""
        start = self.at
        self.at += length
        if self.at > len(self.data):
            raise Damaged("a record is shorter than its fields")
        return self.data[start : self.at]

    def text(self) -> str:
        """Read the next string; invalid UTF-8 and characters that do not print become escapes."""
        return escape_controls(self.lines())

    def lines(self) -> str:
        """Read the next string, in which only invalid UTF-8 becomes escapes."""
        length = self.field("I")
        if length > STRING_BYTES:
            raise Damaged(f"a string is {length} bytes, allowed are {STRING_BYTES}")
        return self.block(length).decode("utf-8", "backslashreplace")

    def texts(self) -> dict[str, str]:
        """Read the next map of strings, whose values may have several lines."""
        end = self.field("I") + self.at
        pairs: dict[str, str] = {}
        while self.at < end:
            name = self.text()
            pairs[name] = self.lines()
            if len(pairs) > PAIRS:
                raise Damaged(f"a map has more than the {PAIRS} strings allowed")
        if self.at != end:
            raise Damaged("a map of strings does not end where its length puts it")
        return pairs


def _fields(content: bytes, layout: str, own: bool) -> list[Any]:
    """The fields of a record, a letter each.

    `H`, `I` and `Q` are numbers of 16, 32 and 64 bits, `s` is a string, `m` a map of strings, `b`
    and `B` are bytes with a length of 32 and 64 bits.
    """
    cursor = _Cursor(content)
    values = [cursor.field(kind) for kind in layout]
    # The format lets other writers append fields; our writer does not.
    if own and cursor.at != len(content):
        raise Damaged("a record is longer than its fields")
    return values


def header_library(content: bytes, own: bool = False) -> str:
    """The library that a header record names."""
    _, library = _fields(content, "ss", own)
    if library.startswith(OWN_LIBRARY):
        _fields(content, "ss", own=True)
    return str(library)


def channel_record(content: bytes, own: bool = False) -> ChannelRecord:
    """Parse a channel record."""
    channel, _, topic, encoding, metadata = _fields(content, "HHssm", own)
    return ChannelRecord(channel, topic, encoding, metadata)


def metadata_record(content: bytes, own: bool = False) -> tuple[str, dict[str, str]]:
    """Parse a metadata record into its name and pairs."""
    name, pairs = _fields(content, "sm", own)
    return name, pairs


def attachment_record(content: bytes, own: bool = True) -> AttachmentRecord:
    """Parse an attachment. Raises Damaged if its fields or its checksum are wrong."""
    log_time, _, name, media_type, data, crc = _fields(content, "QQssBI", own)
    if (crc or own) and crc != zlib.crc32(memoryview(content)[:-4]):
        raise Damaged("the checksum (CRC) of an attachment is wrong")
    return AttachmentRecord(name, media_type, log_time, data)


def check_schema(content: bytes, own: bool) -> None:
    """Raise Damaged if a schema record's fields are inconsistent; the schema itself is not read."""
    _fields(content, "Hssb", own)


def check_message_index(content: bytes, own: bool) -> None:
    """Raise Damaged if a message index record's fields are inconsistent."""
    _, entries = _fields(content, "Hb", own)
    if len(entries) % 16:
        raise Damaged("a message index has half an entry")


class Statistics(NamedTuple):
    """What a file says of itself at its end: how many there are of each, the times, by channel."""

    messages: int
    channels: int
    chunks: int
    first: int
    last: int
    counts: dict[int, int]


def statistics_record(content: bytes, own: bool = False) -> Statistics:
    """Parse a statistics record."""
    messages, _, channels, _, _, chunks, first, last, counts = _fields(content, "QHIIIIQQb", own)
    if len(counts) % _COUNT.size:
        raise Damaged("the statistics have half a count")
    return Statistics(messages, channels, chunks, first, last, dict(_COUNT.iter_unpack(counts)))


class ChunkFields(NamedTuple):
    """The front of a chunk: unpacked size, CRC, compression, where the packed bytes start, and how
    many they are.
    """

    size: int
    crc: int
    compression: str
    start: int
    packed: int


def chunk_fields(content: bytes) -> ChunkFields:
    """Parse a chunk, or its front."""
    try:
        size, crc, length = _CHUNK.unpack_from(content)
        start = _CHUNK.size + length + _U64.size
        compression = content[_CHUNK.size : _CHUNK.size + length].decode("ascii", "replace")
        packed: int = _U64.unpack_from(content, start - _U64.size)[0]
    except struct.error as error:
        raise Damaged("a record is shorter than its fields") from error
    return ChunkFields(size, crc, compression, start, packed)


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
        if opcode != MESSAGE:
            others += 1
            if others > DESCRIPTIONS:
                raise Damaged(
                    f"a chunk holds more than {DESCRIPTIONS} records that are not messages"
                )
        elif length < MESSAGE_HEAD.size:
            raise Damaged("a message is shorter than its fields")
        yield opcode, start, at
