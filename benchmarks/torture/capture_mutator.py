"""Damages capture files deep inside: chunks are unpacked, changed and packed again.

Lengths, checksums and the index are put right afterwards, most of the time: what only
breaks a checksum gets no further than the reader's first look.
"""

from __future__ import annotations

import io
import json
import re
import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from random import Random
from struct import pack, pack_into, unpack_from
from typing import Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Chunk

from bilprov.captures.storage.records import MAGIC, MESSAGE_HEAD, RECORD_HEAD
from bilprov.captures.topics import CHANNEL_START_KEY, METADATA_NAME, START_KEY, TOPICS

_CHUNK_INDEX = 0x08
_NUMBERS = (0, 1, 16, 255, 1 << 16, 1 << 24, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 62)
_LONGEST = 1 << 16  # bytes of what is damaged
_HOW_MANY = (1, 1, 1, 1, 1, 2, 2, 3, 5, 9)
_LENGTHS = (1, 1, 2, 3, 4, 8, 9, 16, 64)
_TIMES = (0, 1, 1 << 31, (1 << 53) + 1, 1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
_LARGEST = 1 << 17  # bytes of an unpacked chunk that is changed

# Texts that readers stumble over.
_HOSTILE = (
    *("", " ", "\0", "\n", "\r\n", "\x1b[31m", "\u202e", "\u2028", "\ufeff", "\ud800"),
    *("\U0010ffff", "é", "\xb2", "٣", "[/x]", "%s", "{0}", "=1+1", "../", "~", "-", "--"),
    *("a" * 300, "'" * 3, "nan", "inf", "-inf", "1e999", "-0", "1_0", "0x", "0b2", "08"),
    *("1e-400", "9" * 30, "9" * 5000),
)
_WORDS = tuple(
    text.encode("utf-8", "surrogatepass")
    for text in (
        *(text for topic in TOPICS for text in (topic.name, topic.encoding)),
        *(START_KEY, CHANNEL_START_KEY, METADATA_NAME, "bilprov ", "zstd", "lz4", "json"),
        *_HOSTILE,
    )
)

_pack = zstandard.ZstdCompressor(level=1).compress
_VALUE = re.compile(rb'(?<=[:,\[])\s*("[^"]*"|[^][{}:,"]+)')  # in JSON; some are keys
_VALUES = tuple(
    json.dumps(value).encode()
    for value in (
        *(None, True, -1, 256, 0.5, 1e308, 1 << 63, 1 << 64, -(1 << 70), float("nan"), [], {}),
        *([None], {"": None}, *_HOSTILE),
    )
)


class Record(NamedTuple):
    """A record: its opcode, and its content without opcode and length."""

    opcode: int
    content: bytes


def changed_capture(random: Random, pool: Sequence[bytes]) -> bytes:
    """A capture from the pool with some changes, most of them inside of its records."""
    data = random.choice(pool)
    if random.random() < 0.15:
        return _damaged(random, data, pool)
    found, rest = split(data[len(MAGIC) :])
    for _ in range(random.choice((1, 1, 1, 2, 3, 6))):
        _change(random, found, pool, inside=False)
    data = _joined(found, right=random.random() < 0.8) + rest
    kind = random.random()
    if kind < 0.05:
        data = data[: random.randrange(len(data) + 1)]
    elif kind < 0.15:
        data = _damaged(random, data, pool)
    return data


def split(data: bytes) -> tuple[list[Record], bytes]:
    """The complete records in some bytes, and what is left over."""
    found, at = [], 0
    while at + RECORD_HEAD.size <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        start = at + RECORD_HEAD.size
        if start + length > len(data):
            break
        found.append(Record(opcode, data[start : start + length]))
        at = start + length
    return found, data[at:]


def _change(random: Random, found: list[Record], pool: Sequence[bytes], inside: bool) -> None:
    """Change a list of records at a random place; those of a chunk if `inside`."""
    if found and random.random() < 0.6:
        at = random.randrange(len(found))
        found[at] = _changed(random, found[at], pool)
        return
    others, _ = split(random.choice(pool)[len(MAGIC) :])
    chunks = [one for one in others if one.opcode == Opcode.CHUNK]
    if inside and chunks:
        others, _ = split(_unpacked(random.choice(chunks).content) or b"")
    _change_items(random, found, others, lambda: others[:1])


def _changed(random: Random, record: Record, pool: Sequence[bytes]) -> Record:
    opcode, content = record
    if random.random() < 0.03:
        return Record(random.choice((*range(17), 0x80, 0xFF)), content)
    if opcode == Opcode.CHUNK and random.random() < 0.9:
        inner = _unpacked(content)
        if inner is not None:
            parts, rest = split(inner)
            for _ in range(random.choice((1, 1, 2, 3, 8))):
                _change(random, parts, pool, inside=True)
            return Record(opcode, _packed(random, _bytes(parts) + rest, content))
    if opcode == Opcode.MESSAGE and len(content) >= MESSAGE_HEAD.size and random.random() < 0.8:
        return Record(opcode, _changed_message(random, content, pool))
    return Record(opcode, _damaged(random, content, pool))


def _changed_message(random: Random, content: bytes, pool: Sequence[bytes]) -> bytes:
    channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(content)
    data = content[MESSAGE_HEAD.size :]
    kind = random.randrange(5)
    if kind == 0:
        channel = random.choice((channel + 1, 0, 1, 2, 3, 77, 65535)) & 0xFFFF
    elif kind == 1:
        sequence = random.choice((sequence + 1, sequence + 9, sequence - 1, 0, (1 << 32) - 1))
    elif kind == 2:
        moved = log_time + random.choice((-1, 1, 10**9, -(10**9), 10**15))
        log_time = random.choice((*_TIMES, moved, moved, moved))
    elif data.startswith(b"{"):
        data = _changed_json(random, data)
    else:
        data = _damaged(random, data, pool)
    head = MESSAGE_HEAD.pack(
        channel, sequence & (1 << 32) - 1, log_time & (1 << 64) - 1, publish_time
    )
    return head + data


def _changed_json(random: Random, data: bytes) -> bytes:
    """JSON with other values, or keys, in up to three places."""
    for _ in range(random.choice((1, 1, 2, 3))):
        if places := [found.span(1) for found in _VALUE.finditer(data)]:
            start, end = random.choice(places)
            data = data[:start] + random.choice(_VALUES) + data[end:]
    return data


def _change_items(random: Random, items: Any, others: Any, news: Callable[[], Any]) -> None:
    """Make one change in bytes or a list: a part goes, comes again or moves, or a new one comes.

    `others` are those of another input, `news` gives pieces that are in none.
    """
    at, count = random.randrange(len(items) + 1), random.choice(_LENGTHS)
    kind = random.randrange(6)
    if kind == 0:
        del items[at : at + count]
    elif kind == 1:
        items[at:at] = items[at : at + count] * random.choice((1, 1, 2, 40))
    elif kind == 2:
        start = random.randrange(len(others) + 1)
        part = others[start : start + count]
        items[at : at + random.choice((0, len(part)))] = part
    elif kind == 3 and items:
        other = random.randrange(len(items))
        at = min(at, len(items) - 1)
        items[at], items[other] = items[other], items[at]
    else:
        new = news()
        items[at : at + random.choice((0, len(new)))] = new


def _damaged(random: Random, data: bytes, pool: Sequence[bytes]) -> bytes:
    """Some bytes with one to nine changes; parts of others in the pool may get into them."""
    changed = bytearray(data)

    def new() -> bytes:
        number = (random.choice(_NUMBERS) + random.randint(-1, 1)) % (1 << 64)
        cut = number.to_bytes(8, "little")[: random.choice((1, 2, 4, 8))]
        return random.choice(
            (cut, random.randbytes(random.choice(_LENGTHS)), random.choice(_WORDS))
        )

    for _ in range(random.choice(_HOW_MANY)):
        if changed and random.random() < 0.2:
            changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
        else:
            _change_items(random, changed, random.choice(pool), new)
    return bytes(changed[:_LONGEST])


def _unpacked(content: bytes) -> bytes | None:
    """The records in a chunk; None if it cannot be unpacked, or holds too much."""
    try:
        chunk = Chunk.read(ReadDataStream(io.BytesIO(content)))
        packed, compression = chunk.data, chunk.compression
        if chunk.uncompressed_size > _LARGEST:
            return None
        if compression == "zstd":
            return zstandard.ZstdDecompressor().decompress(packed, max_output_size=_LARGEST)
        data: bytes = lz4.frame.decompress(packed) if compression == "lz4" else packed
    except (EndOfFile, struct.error, zstandard.ZstdError, RuntimeError, ValueError, MemoryError):
        return None
    return data if len(data) <= _LARGEST else None


def _packed(random: Random, data: bytes, before: bytes) -> bytes:
    """A chunk of these records, with the times of the one before."""
    compression = random.choice((b"zstd", b"", b"", b"lz4"))
    pack_by: dict[bytes, Callable[[bytes], bytes]] = {
        b"zstd": _pack,
        b"lz4": lz4.frame.compress,
        b"": bytes,
    }
    packed = pack_by[compression](data)
    size, crc = len(data), zlib.crc32(data)
    kind = random.random()
    if kind < 0.03:
        size = random.choice((0, size + 1, 1 << 24, 1 << 33, (1 << 64) - 1))
    elif kind < 0.06:
        crc = random.choice((0, crc ^ 1))
    front = before[:16] + pack("<QII", size, crc, len(compression)) + compression
    return front + pack("<Q", len(packed)) + packed


def _bytes(found: Iterable[Record]) -> bytes:
    return b"".join(RECORD_HEAD.pack(one.opcode, len(one.content)) + one.content for one in found)


def _joined(found: list[Record], right: bool) -> bytes:
    """The file of these records; if `right`, with an index and checksums that fit."""
    if not right:
        return MAGIC + _bytes(found)
    out = bytearray(MAGIC)
    chunks: list[tuple[int, int]] = []
    summary = entry = 0
    for record in found:
        opcode, content, at = record.opcode, bytearray(record.content), len(out)
        try:
            if opcode == Opcode.CHUNK:
                chunks.append((at, len(content) + RECORD_HEAD.size))
            elif opcode == Opcode.ATTACHMENT:
                pack_into("<I", content, len(content) - 4, zlib.crc32(content[:-4]))
            elif opcode == Opcode.DATA_END:
                summary = at + RECORD_HEAD.size + len(content)
                pack_into("<I", content, 0, zlib.crc32(out))
            elif opcode == _CHUNK_INDEX and entry < len(chunks):
                pack_into("<QQ", content, 16, *chunks[entry])
                entry += 1
            elif opcode == Opcode.FOOTER and summary:
                offset = unpack_from("<Q", content, 8)[0]
                pack_into("<QQ", content, 0, summary, offset)
                head = RECORD_HEAD.pack(opcode, len(content))
                crc = zlib.crc32(bytes(out[summary:]) + head + bytes(content[:16]))
                pack_into("<I", content, 16, crc)
        except struct.error:
            pass  # it is too short for its fields, and stays so
        out += RECORD_HEAD.pack(opcode, len(content)) + content
    return bytes(out)
