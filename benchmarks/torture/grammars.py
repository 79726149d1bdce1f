"""Hostile grammars as a capture brings them: each is refused in a sentence, or loaded and used.

Wrong declarations and bombs made by hand, and mutants drawn by the seed (`hostile_grammars`). All
are read in one process of its own, whose peak memory is measured once; each has its CPU time.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

import bilprov.spec
from benchmarks.commands import Skipped, run
from benchmarks.hostile_grammars import BOMBS, WRONG, bomb, loaded_or_said, mutant, mutated, use
from benchmarks.torture.harm import Harm, Progress, Row

_CPU = 2.0  # s for one grammar
_MEMORY = 200_000_000  # bytes of all of it, at the highest
_LONGEST = 400  # characters of a sentence
_HEADERS = 16  # that a grammar which loads is used with
_PATIENCE = 480.0  # s

KINDS = {
    "wrong": "embedded grammars with a wrong declaration, made by hand",
    "bombs": "embedded grammars that would take memory or time without end",
    "mutants": "embedded grammars with one to three random changes",
}
"""What each row is about."""


def texts(runs: int, seed: int) -> Iterator[tuple[str, str, str]]:
    """The kind, the name and the text of each grammar; of the mutants as many as `runs`."""
    good = (Path(bilprov.spec.__path__[0]) / "grammar.py").read_text()
    for name in WRONG:
        yield "wrong", name, mutated(good, WRONG[name][0])
    for name in BOMBS:
        yield "bombs", name, bomb(good, name)
    for number in range(runs):
        yield "mutants", f"number {number}", mutant(good, Random(f"{seed} {number}"))


def read(text: str, random: Random) -> dict[str, Any]:
    """What comes of a grammar: whether it is refused, its CPU time (s), and what is wrong."""
    begun, wrong, protocol = time.process_time(), "", None
    try:
        protocol = loaded_or_said(text)
        if not isinstance(protocol, str):
            use(protocol, random.sample(range(256), _HEADERS))
        elif not protocol.isprintable() or not 0 < len(protocol) <= _LONGEST:
            wrong = f"the sentence does not print or is long: {protocol[:_LONGEST]!r}"
    except Exception as error:  # whatever it is, it is what is looked for
        wrong = f"{type(error).__name__}: {error}"[:_LONGEST]
    took = time.process_time() - begun
    if took > _CPU and not wrong:
        wrong = f"it took {took:.1f} s of computing"
    return {"refused": isinstance(protocol, str), "took": took, "wrong": wrong}


def _all(runs: int, seed: int, path: str) -> None:
    """Read all of them, and write a line for each: before, what it is; after, what came of it."""
    with Path(path).open("w", buffering=1) as out:
        for kind, name, text in texts(runs, seed):
            out.write(json.dumps([kind, name]) + "\n")
            out.write(json.dumps(read(text, Random(name))) + "\n")


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    """Read them in another process; a row for each kind, and one for the memory."""
    wrong: list[str] = []
    memory = 0
    with tempfile.NamedTemporaryFile("r") as file:
        words = [sys.executable, "-m", __name__, str(runs), str(seed), file.name]
        try:
            memory = run(words, patience=_PATIENCE).memory
        except (Skipped, RuntimeError) as error:
            wrong.append(str(error)[-_LONGEST:])
        lines = [json.loads(line) for line in file]
    came = list(zip(lines[::2], lines[1::2], strict=False))
    if len(lines) % 2:
        wrong.append(f"it ended at {': '.join(lines[-1])}")
    if memory > _MEMORY:
        wrong.append(f"{memory / 1e6:.0f} MB, allowed are {_MEMORY / 1e6:.0f} MB")
    progress(runs)
    rows = [
        _row(about, [(name, one) for (kind, name), one in came if kind == of])
        for of, about in KINDS.items()
    ]
    told = f"{memory / 1e6:.0f} MB at the highest" if memory else "not measured"
    return [*rows, Row("all of these read by one process", len(came), told, tuple(wrong))]


def _row(about: str, came: list[tuple[str, dict[str, Any]]]) -> Row:
    found = tuple(f"{name}: {one['wrong']}" for name, one in came if one["wrong"])
    refused = sum(one["refused"] for _, one in came)
    longest = max((one["took"] for _, one in came), default=0.0)
    return Row(
        about,
        len(came),
        f"{len(found)} exceptions or bad sentences; {refused} refused with a sentence, "
        f"{len(came) - refused - len(found)} loaded and used; {longest:.2f} s of CPU at most",
        found,
    )


HARM = Harm("grammars", "hostile grammars in captures", 2000, _measure)

if __name__ == "__main__":
    _all(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
