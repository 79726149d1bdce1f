"""The limits of MCAP records, and what is wrong with those that are rejected."""

from __future__ import annotations

import struct
from typing import Final, TypeVar

import msgspec

MAGIC: Final = b"\x89MCAP0\r\n"
OWN_LIBRARY: Final = "bilprov "
"""The prefix of the library's name in our own files."""

RECORD_HEAD: Final = struct.Struct("<BQ")
MESSAGE_HEAD: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
FOOTER_BYTES: Final = 20
DATA_END_BYTES: Final = 4

# The largest parts that are read; checked before memory is allocated.
CHUNK_BYTES: Final = 16 * 1024 * 1024  # of one chunk, as stored and as unpacked
MESSAGE_BYTES: Final = 64 * 1024  # of data of one message
STRING_BYTES: Final = 64 * 1024  # of one string of a header, a channel or a metadata record
STRINGS: Final = 8192  # of one record: each costs many times its bytes
RECORD_BYTES: Final = 16 * 1024 * 1024  # of any other record whose content is read
ATTACHMENT_BYTES: Final = 64 * 1024 * 1024  # of one attachment whose content is read
CHANNELS: Final = 64  # in one file
DESCRIPTIONS: Final = 4096  # records of a chunk that are no messages: schemas and channels

JSON_ERRORS: Final = (msgspec.MsgspecError, ValueError, RecursionError)
"""Exceptions for JSON that cannot be decoded; deep nesting raises RecursionError."""


Value = TypeVar("Value")


def decoded(data: bytes, kind: type[Value]) -> Value | None:
    """The value of this type that JSON holds, None if it does not."""
    try:
        return msgspec.json.decode(data, type=kind)
    except JSON_ERRORS:
        return None


class Damaged(Exception):
    """A record is inconsistent. The message says what is wrong, but not where."""


class CutOff(Damaged):
    """A record ends after the end of the file, as usual in a capture that was not finished."""
