"""How much a damaged place costs of a capture of many chunks: the chunks it lies in, no more.

A bit is flipped, or up to 512 bytes are overwritten, anywhere in the file, its first bytes
included: 90 % of the messages at least are kept. Or the file is cut anywhere: every message of
every chunk that is wholly before the cut is kept. No message is read that was not recorded.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from functools import cache
from random import Random
from typing import NamedTuple

from benchmarks.fuzz import engine
from benchmarks.torture.damage import bounds, messages
from benchmarks.torture.harm import Harm, Progress, Row
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.replay.recorder import session_metadata
from bilprov.captures.errors import CaptureError
from bilprov.captures.schemas import MS, Chunk
from bilprov.captures.storage import records
from bilprov.captures.storage.records import MAGIC
from bilprov.captures.writer import CaptureWriter

CHUNKS = 120
_MESSAGES = 20  # of a chunk
_LEAST = 0.9  # of the messages that one damaged place leaves
_OVERWRITTEN = 512  # bytes at most
_FRONT = 0.1  # of the damaged places are in the first bytes, which say that it is MCAP

Change = Callable[[Random, bytes], bytes]


@cache
def recorded() -> bytes:
    """A finished capture of many chunks."""
    path = engine.folder() / "chunks.mcap"
    path.unlink(missing_ok=True)
    protocol = load_protocol()
    about = session_metadata(
        protocol, ports={}, line="", timeout=50 * MS, skew=0, heard=("host", "device")
    )
    draw = Random(1)
    with CaptureWriter(path, start_wall=1_790_000_000 * 10**9, metadata=about, version="0") as out:
        for number in range(CHUNKS * _MESSAGES):
            out.chunk(Chunk(number * MS, draw.choice(("host", "device")), draw.randbytes(6)))
            if number % _MESSAGES == _MESSAGES - 1:
                out.flush()
    return path.read_bytes()


def _place(random: Random, size: int) -> int:
    return random.randrange(len(MAGIC) if random.random() < _FRONT else size)


def _flipped(random: Random, data: bytes) -> bytes:
    changed = bytearray(data)
    changed[_place(random, len(data))] ^= 1 << random.randrange(8)
    return bytes(changed)


def _overwritten(random: Random, data: bytes) -> bytes:
    at = _place(random, len(data))
    new = random.randbytes(min(random.randint(1, _OVERWRITTEN), len(data) - at))
    return data[:at] + new + data[at + len(new) :]


def _cut(random: Random, data: bytes) -> bytes:
    return data[: random.randrange(1, len(data))]


CHANGES: dict[str, Change] = {
    "one flipped bit": _flipped,
    f"up to {_OVERWRITTEN} bytes overwritten": _overwritten,
    "a cut": _cut,
}


class Kept(NamedTuple):
    """How much of a capture is kept of what has to be, and what is wrong, or ""."""

    share: float
    wrong: str = ""


def kept(data: bytes) -> Kept:
    """Read what is left of the capture: all of it, or what is wholly before a cut, has to be."""
    whole = recorded()
    ends = bounds(whole)
    chunks = sum(whole[at] == records.CHUNK for at in ends[: bisect_right(ends, len(data)) - 1])
    has_to_be = chunks * _MESSAGES
    path = engine.folder() / "changed.mcap"
    path.write_bytes(data)
    known = held()
    try:
        read = messages(path)
    except CaptureError as error:
        return Kept(0.0, f"it is refused: {error}") if has_to_be else Kept(1.0)
    if not {*read} <= known:
        return Kept(0.0, "a message is read that was not recorded")
    share = len({*read}) / has_to_be if has_to_be else 1.0
    least = 1.0 if len(data) < len(whole) else _LEAST
    return Kept(min(1.0, share), "" if share >= least else f"{share:.1%} is kept")


@cache
def held() -> frozenset[tuple[int, str, str]]:
    """The messages of the whole capture."""
    path = engine.folder() / "whole.mcap"
    path.write_bytes(recorded())
    return frozenset(messages(path))


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    return [_row(name, change, -(-runs // 3), seed, progress) for name, change in CHANGES.items()]


def _row(name: str, change: Change, runs: int, seed: int, progress: Progress) -> Row:
    random = Random(f"{seed} {name}")
    shares, wrong = [], []
    for number in range(runs):
        share, sentence = kept(change(random, recorded()))
        shares.append(share)
        if sentence:
            wrong.append(f"run {number}: {sentence}")
        progress(1)
    of_what = "what is wholly before it" if change is _cut else "the messages"
    return Row(
        f"{name} anywhere in a capture of {CHUNKS} chunks",
        runs,
        f"of {of_what} {sum(shares) / runs:.3%} are kept, {min(shares):.3%} in the worst case",
        tuple(wrong),
    )


HARM = Harm("chunks", "a damaged place in a capture of many chunks", 6_000, _measure)
