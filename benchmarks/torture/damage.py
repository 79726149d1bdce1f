"""Damaged captures: what is read of them, whether the loss is told, what `repair` makes of them.

Each run damages a small capture in one way and opens it by its survey and by its index, reads it in
every way, examines it as `capture check` does and mends it as `capture repair` does. It may be
refused with a sentence; else what is missing must be told, and nothing may be read that was not
recorded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import accumulate
from pathlib import Path
from random import Random
from typing import NamedTuple

from mcap.opcode import Opcode

from benchmarks.torture.capture_mutator import split
from benchmarks.torture.capture_seeds import foreign_captures, loose_capture, own_captures, parts
from benchmarks.torture.capture_uses import examined, mended
from benchmarks.torture.guard import folder, guarded, watched
from benchmarks.torture.harm import Harm, Row, tracked
from bilprov.analyzer.doctor.finding import Grade, of_capture
from bilprov.captures.errors import CaptureError
from bilprov.captures.parts import part_path
from bilprov.captures.reader import open_capture
from bilprov.captures.storage.records import MAGIC, RECORD_HEAD

Messages = list[tuple[int, str, str]]


class Kind(NamedTuple):
    """A kind of capture: its files; whether bilprov wrote it, and whether messages are in chunks.

    What bilprov reads of its own files stands under a checksum. In those of others the table of
    channels may not, and what is in no chunk has none at all.
    """

    name: str
    files: tuple[bytes, ...]
    own: bool = True
    chunked: bool = True


@cache
def kinds() -> tuple[Kind, ...]:
    """The captures that are damaged."""
    own = own_captures()
    names = ("whole", "without decoded topics", "cut off")
    return (
        *map(Kind, names, ((one,) for one in own)),
        Kind("without its index", (own[0][: _data_end(own[0])],)),
        *(Kind(f"foreign {n}", (one,), own=False) for n, one in enumerate(foreign_captures())),
        Kind("foreign, no chunks", (loose_capture(),), own=False, chunked=False),
        Kind("in parts", parts()),
    )


def _bounds(data: bytes) -> list[int]:
    """Where the records of a capture begin, and where the last whole one ends."""
    found, _ = split(data[len(MAGIC) :])
    sizes = (RECORD_HEAD.size + len(one.content) for one in found)
    return [*accumulate(sizes, initial=len(MAGIC))]


def _data_end(data: bytes) -> int:
    return next(at for at in _bounds(data) if data[at] == Opcode.DATA_END)


def _stretch(random: Random, data: bytes) -> tuple[int, int]:
    """A stretch of a file: in half of the cases of whole records, else of any bytes."""
    places = _bounds(data)
    if random.random() < 0.5 and len(places) > 1:
        first = random.randrange(len(places) - 1)
        return places[first], places[min(len(places) - 1, first + random.choice((1, 1, 2, 3, 8)))]
    at = random.randrange(len(data))
    longest = random.choice((4, 64, 512, len(data)))
    return at, min(len(data), at + random.randint(1, longest))


Damage = Callable[[Random, bytes, int, int], bytes]
"""What becomes of a file whose stretch from one byte to another is damaged."""


def _flip(random: Random, data: bytes, first: int, end: int) -> bytes:
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 2, 8))):
        changed[random.randrange(len(data))] ^= 1 << random.randrange(8)
    return bytes(changed)


def _insert(random: Random, data: bytes, first: int, end: int) -> bytes:
    return data[:first] + random.randbytes(random.choice((1, 9, 100, 5000))) + data[first:]


def _move(random: Random, data: bytes, first: int, end: int) -> bytes:
    to, _ = _stretch(random, data)
    rest = data[:first] + data[end:]
    return rest[:to] + data[first:end] + rest[to:]


DAMAGES: dict[str, Damage] = {
    "flipped bits": _flip,
    "a stretch overwritten": lambda random, data, first, end: (
        data[:first] + random.randbytes(end - first) + data[end:]
    ),
    "a stretch of zeros": lambda _, data, first, end: (
        data[:first] + bytes(end - first) + data[end:]
    ),
    "a cut": lambda _, data, first, end: data[: first or end],
    "a stretch doubled": lambda _, data, first, end: data[:end] + data[first:],
    "a stretch removed": lambda _, data, first, end: data[:first] + data[end:],
    "foreign bytes inserted": _insert,
    "a stretch moved": _move,
}


class Outcome(NamedTuple):
    """What one run came to: `refused`, or how many messages are missing; what is wrong, or ""."""

    refused: bool = False
    missing: int = 0
    wrong: str = ""


def _placed(files: tuple[bytes, ...]) -> Path:
    """Write the files of a capture; gives the name under which it is opened."""
    name = folder() / ("input.mcap" if len(files) == 1 else "input-in-parts.mcap")
    for number, data in enumerate(files, 1):
        (part_path(name, number) if len(files) > 1 else name).write_bytes(data)
    return name


def _messages(path: Path) -> Messages:
    """The messages of a capture in order, with the wall clock's times."""
    capture = open_capture(path)
    start = capture.start
    return [(start + one.t, one.topic, repr(one.data)) for one in capture.messages()]


@cache
def _recorded(kind: Kind) -> Messages:
    """The messages of a capture before it is damaged."""
    return _messages(_placed(kind.files))


def judged(kind: Kind, files: tuple[bytes, ...]) -> Outcome:
    """Read a damaged capture of a kind in every way. Raises what the reader raises."""
    held = _recorded(kind)
    path = _placed(files)
    found = list(of_capture(path))
    try:
        read = _messages(path)
        examined(path)
        mended(path)
    except CaptureError:
        told = any(one.grade is Grade.BLOCKS for one in found)
        return Outcome(
            True, wrong="" if told else "`capture check` does not tell why it is refused"
        )
    missing = (Counter(held) - Counter(read)).total()
    more = (Counter(read) - Counter(held)).total()
    grades = {one.grade for one in found if one.check != "mend"}
    # A capture that was cut short has lost its end, and nothing before it.
    at_end = Grade.ADVICE in grades and (not kind.own or read == held[: len(read)])
    told = Grade.BLOCKS in grades or at_end
    strange = len({*read} - {*held})
    wrong = ""
    if strange and (kind.own or (kind.chunked and not told)):
        wrong = f"{strange} messages are read that were not recorded"
    elif not told and (missing > more or (kind.chunked and missing + more)):
        wrong = f"{missing} messages are missing and {more} there twice, which nothing tells"
    return Outcome(False, missing, wrong)


def _damaged(random: Random, kind: Kind, damage: Damage) -> tuple[bytes, ...]:
    at = random.randrange(len(kind.files))
    damaged = damage(random, kind.files[at], *_stretch(random, kind.files[at]))
    return (*kind.files[:at], damaged, *kind.files[at + 1 :])


def _outcomes(damage: Damage, runs: int, random: Random) -> Iterator[Outcome]:
    for run in tracked(range(runs), runs):
        kind = random.choice(kinds())
        read = partial(judged, kind, _damaged(random, kind, damage))
        outcome = guarded(read)
        if not isinstance(outcome, Outcome):
            outcome = Outcome(wrong=str(outcome))
        yield outcome._replace(wrong=outcome.wrong and f"run {run}, {kind.name}: {outcome.wrong}")


def _measure(runs: int, seed: int) -> list[Row]:
    """Do each kind of damage about as often as any other; a row for each."""
    rows = []
    for number, (name, damage) in enumerate(DAMAGES.items()):
        share = len(range(number, runs, len(DAMAGES)))
        with watched():
            outcomes = list(_outcomes(damage, share, Random(f"{seed} {name}")))
        rows.append(_row(name, outcomes))
    return rows


def _row(name: str, outcomes: list[Outcome]) -> Row:
    refused = sum(one.refused for one in outcomes)
    lost = sum(one.missing > 0 for one in outcomes)
    whole = len(outcomes) - refused - lost
    return Row(
        f"captures with {name}, read, examined and mended",
        len(outcomes),
        f"{whole:,} whole, {lost:,} with messages missing, {refused:,} refused with a sentence",
        tuple(one.wrong for one in outcomes if one.wrong),
    )


HARM = Harm("damage", "damaged captures are read, examined and mended", 30_000, _measure)
