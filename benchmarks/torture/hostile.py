"""Hostile capture files: what `info`, `replay`, `check` and `repair` take of them, and how long.

Each file is made by hand, at any size that it claims, and given to each command in a process of its
own. It may be read or refused with a sentence, in at most 200 MB and 120 s of computing.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from struct import pack
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from benchmarks.commands import bilprov_words, run_any
from benchmarks.product import metadata
from benchmarks.torture.harm import Harm, Row, tracked
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures import topics
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.captures.storage.records import MAGIC, MESSAGE_HEAD, RECORD_HEAD
from bilprov.captures.writer import CaptureWriter

MOST_MEMORY = 200_000_000  # bytes at the peak
MOST_COMPUTING = 120.0  # s
_PATIENCE = 300.0  # s, after which a command hangs
_MILLION = 1_000_000
_BOMB = 1 << 30  # bytes

Write = Callable[[Path], None]


def _record(opcode: int, content: bytes = b"", length: int | None = None) -> bytes:
    return RECORD_HEAD.pack(opcode, len(content) if length is None else length) + content


def _text(text: bytes) -> bytes:
    return pack("<I", len(text)) + text


def _channel(number: int, topic: bytes, schema: int = 0) -> bytes:
    return _record(4, pack("<HH", number, schema) + _text(topic) + _text(b"raw") + _text(b""))


def _message(channel: int = 1, t: int = 0, data: bytes = b" ") -> bytes:
    return _record(5, MESSAGE_HEAD.pack(channel, 0, t, t) + data)


def _chunk(content: bytes, packing: bytes = b"", packed: bytes | None = None, **said: int) -> bytes:
    body = content if packed is None else packed
    front = pack(
        "<QQQI", 0, 0, said.get("size", len(content)), said.get("crc", zlib.crc32(content))
    )
    return _record(6, front + _text(packing) + pack("<Q", len(body)) + body)


_HEAD = MAGIC + _record(1, _text(b"") + _text(b"another writer"))
_TABLE = _channel(1, topics.HOST_RAW.encode()) + _channel(2, topics.DEVICE_RAW.encode())
_FOOT = _record(0x0F, bytes(4)) + _record(2, bytes(20)) + MAGIC


def _foreign(parts: Callable[[], Iterable[bytes]] = tuple, foot: bytes = _FOOT) -> Write:
    """A file of another program, of these parts."""
    begin = _HEAD, _chunk(_TABLE + _message())
    return lambda path: _written(path, (*begin, *parts(), foot))


def _written(path: Path, parts: Iterable[bytes]) -> None:
    with path.open("wb") as file:
        file.writelines(parts)


def _packed(content: bytes) -> bytes:
    return _chunk(content, b"zstd", zstandard.compress(content))


def _bomb(packing: bytes, size: int) -> bytes:
    """A chunk that unpacks to a GiB and says that it has `size` bytes."""
    block = bytes(1 << 20)
    if packing == b"zstd":
        packer = zstandard.ZstdCompressor().compressobj()
        packed = b"".join(packer.compress(block) for _ in range(_BOMB >> 20)) + packer.flush()
    else:
        frame = lz4.frame.LZ4FrameCompressor()
        parts = [frame.begin(), *(frame.compress(block) for _ in range(_BOMB >> 20))]
        packed = b"".join([*parts, frame.flush()])
    return _chunk(b"", packing, packed, size=size, crc=1)


def _own(events: Callable[[], Iterable[Chunk | Line]], **changed: str) -> Write:
    """A file of bilprov's writer, with these events."""

    def write(path: Path) -> None:
        about = metadata(load_protocol()) | changed
        with CaptureWriter(path, start_wall=10**18, metadata=about, version="0") as out:
            for event in events():
                if isinstance(event, Chunk):
                    out.chunk(event)
                else:
                    out.write(event, event.t)

    return write


def _at_one_time(size: int) -> Iterator[Chunk]:
    """A million instructions in chunks of `size`, and an answer long after them."""
    lengths = load_protocol().lengths
    frame = next(bytes([header]) for header in range(256) if not lengths[header])
    yield from [Chunk(5 * MS, "host", frame * size)] * (_MILLION // size)
    yield Chunk(10**12, "device", bytes(1))


def _sparse(path: Path) -> None:
    _foreign()(path)
    with path.open("r+b") as file:
        file.truncate(8 << 30)


def _index(*entries: tuple[int, int], start: int | None = None, crc: int = 0) -> Write:
    """A finished file whose chunk index has these offsets and lengths."""

    def write(path: Path) -> None:
        front = _HEAD + _chunk(_TABLE + _message()) + _record(0x0F, bytes(4))
        summary = b"".join(
            _record(8, pack("<QQQQI", 0, 0, *entry, 0) + pack("<Q", 0) + _text(b"") + bytes(16))
            for entry in entries
        )
        at = len(front) if start is None else start
        _written(path, (front, summary, _record(2, pack("<QQI", at, at, crc)), MAGIC))

    return write


def _statistics(count: int) -> bytes:
    return _record(0x0B, pack("<QHIIIIQQI", count, 0, 0, 0, 0, 0, 0, 0, 0))


def _pairs(count: int, length: int) -> bytes:
    pairs = b"".join(_text(b"%d" % n) + _text(b"x" * length) for n in range(count))
    return _record(0x0C, _text(topics.METADATA_NAME.encode()) + _text(pairs))


_END = _record(0x0F, bytes(4))
_LAST = (1 << 64) - 1
KINDS: dict[str, Write] = {
    "a chunk of 1 GiB in zstd": _foreign(lambda: [_bomb(b"zstd", _BOMB)]),
    "a chunk of 1 GiB in zstd that says 1 MiB": _foreign(lambda: [_bomb(b"zstd", 1 << 20)]),
    "a chunk of 1 GiB in lz4 that says 1 MiB": _foreign(lambda: [_bomb(b"lz4", 1 << 20)]),
    "a chunk that says 2^63 bytes": _foreign(lambda: [_chunk(b"", size=1 << 63)]),
    "a chunk in a chunk": _foreign(lambda: [_chunk(_chunk(_chunk(_message())))]),
    "a million empty records": _foreign(lambda: [_record(0x20) * _MILLION]),
    "a million empty chunks": _foreign(lambda: [_chunk(b"") * _MILLION]),
    "empty records in a packed chunk": _foreign(lambda: [_packed(_record(0x20) * _MILLION)]),
    "a million channels": _foreign(
        lambda: [*(_channel(n & 0xFFFF, b"/%d" % n) for n in range(_MILLION))]
    ),
    "a million schemas": _foreign(
        lambda: [*(_record(3, pack("<H", n & 0xFFFF) + _text(b"s") * 3) for n in range(_MILLION))]
    ),
    "a channel 10,000 times with other schemas": _foreign(
        lambda: [*(_channel(1, topics.HOST_RAW.encode(), n) for n in range(10_000))]
    ),
    "a topic of 10 MB": _foreign(lambda: [_channel(3, b"/" + b"a" * 10_000_000)]),
    "a record that says 2^63 bytes": _foreign(lambda: [_record(0x0C, b"", 1 << 63)]),
    "an attachment that says 2^63 bytes": _foreign(lambda: [_record(9, b"", 1 << 63)]),
    "an attachment of 300 MB": _foreign(lambda: [_record(9, bytes(300_000_000))]),
    "a million metadata": _foreign(lambda: [_pairs(_MILLION, 0)]),
    "metadata of 15 MB": _foreign(lambda: [_pairs(250, 60_000)]),
    "an index that points to itself": _index((330, 100), (330, 100)),
    "an index that points behind the file": _index((1 << 62, 1 << 62)),
    "a summary that begins behind the file": _index((9, 9), start=1 << 63),
    "a summary of a million entries": _index(*[(9, 9)] * 500_000),
    "statistics that count 2^64 - 1 messages": _foreign(
        lambda: [_END + _statistics(_LAST)], _FOOT[13:]
    ),
    "a message at 2^64 - 1 ns": _foreign(lambda: [_chunk(_message(t=0) + _message(t=_LAST))]),
    "messages in reverse order": _foreign(
        lambda: [
            *(
                _chunk(b"".join(_message(t=MS * (_MILLION - n)) for n in range(at, at + 1000)))
                for at in range(0, 200_000, 1000)
            )
        ]
    ),
    "a million messages of no channel": _foreign(
        lambda: [*(_chunk(_message(99) * 10_000) for _ in range(100))]
    ),
    "a message of 15 MB": _foreign(lambda: [_chunk(_message(data=bytes(15_000_000)))]),
    "250 messages of 64 KB of zeros": _foreign(
        lambda: [_packed(_message(data=bytes(64_000)) * 250)]
    ),
    "8 GiB of nothing": _sparse,
    "an hour of zeros": _own(
        lambda: (Chunk(n * 100 * MS, "host", bytes(100)) for n in range(36_000))
    ),
    "a million instructions at one time": _own(lambda: _at_one_time(1)),
    "a million instructions at one time in chunks of 100": _own(lambda: _at_one_time(100)),
    "a million answers at one time": _own(lambda: [Chunk(5, "device", bytes(100))] * 10_000),
    "half a million line events at one time": _own(
        lambda: [Line(5, "modem", "host", "RTS")] * 500_000
    ),
    "settings that are bombs": _own(
        lambda: [Chunk(0, "host", bytes(9))],
        truncation_timeout_ms="9" * 60_000,
        line="1" * 60_000,
        heard="host " * 10_000,
        grammar_name="(" * 60_000,
        skew_ms="1e999",
    ),
    "a grammar that is a bomb": _own(
        lambda: [Chunk(0, "host", bytes(9))],
        grammar_text=f"NAME = {'(' * 30_000}{')' * 30_000}",
        grammar_sha256="",
    ),
}

COMMANDS: dict[str, Callable[[str], list[str]]] = {
    "capture info": lambda path: ["capture", "info", path],
    "replay": lambda path: ["replay", path, "--rate", "0", "--format", "jsonl"],
    "capture check": lambda path: ["capture", "check", path],
    "capture repair": lambda path: ["capture", "repair", path, path + ".new", "--force"],
}


class Used(NamedTuple):
    """What a command took: seconds of computing and bytes at the peak; what is wrong, or ""."""

    seconds: float
    memory: int
    wrong: str = ""


def used(words: list[str]) -> Used:
    """Run a command and see what it takes."""
    try:
        ended = run_any(words, patience=_PATIENCE)
    except TimeoutError as hangs:
        return Used(_PATIENCE, 0, str(hangs))
    wrong = ""
    if ended.code not in (0, 1, 2, 3) or "Traceback" in ended.error:
        wrong = f"exit code {ended.code}: {ended.error[-200:]}"
    elif ended.memory > MOST_MEMORY or ended.cpu > MOST_COMPUTING:
        wrong = f"{ended.cpu:.0f} s of computing, {ended.memory / 1e6:.0f} MB"
    return Used(ended.cpu, ended.memory, wrong)


def _measure(runs: int, seed: int) -> list[Row]:
    """Make the first so many files, and give each to every command; nothing is drawn."""
    held: dict[str, list[Used]] = {name: [] for name in COMMANDS}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hostile.mcap"
        for name in tracked(list(KINDS)[:runs], runs):
            # In a process of its own, which gives back what some of them take to make.
            maker = multiprocessing.get_context("fork").Process(target=KINDS[name], args=(path,))
            maker.start()
            maker.join()
            if maker.exitcode:
                raise RuntimeError(f"the file with {name} cannot be made")
            for command, words in COMMANDS.items():
                one = used(bilprov_words(*words(str(path))))
                held[command].append(one._replace(wrong=one.wrong and f"{name}: {one.wrong}"))
            path.unlink()
    return [_row(command, rows) for command, rows in held.items()]


def _row(command: str, rows: list[Used]) -> Row:
    seconds, memory = max(row.seconds for row in rows), max(row.memory for row in rows)
    return Row(
        f"hostile files given to `bilprov {command}`",
        len(rows),
        f"at most {seconds:.1f} s of computing and {memory / 1e6:.0f} MB",
        tuple(row.wrong for row in rows if row.wrong),
    )


HARM = Harm("hostile", "hostile capture files of each kind", len(KINDS), _measure)
