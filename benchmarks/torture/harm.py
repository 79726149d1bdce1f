"""A harm that is done to the product so often, and the rows of docs/RELIABILITY.md it gives."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Row:
    """What one kind of harm came to: how often it was done, what was lost, whether all held."""

    harm: str
    times: int
    lost: str
    wrong: tuple[str, ...] = ()
    """What went otherwise than it may, a sentence each."""

    @property
    def held(self) -> bool:
        """Whether nothing went otherwise than it may."""
        return not self.wrong


Progress = Callable[[int], object]
"""Is told how many more runs are done."""


@dataclass(frozen=True, slots=True)
class Harm:
    """A harm: its name on the command line, what it does, how many runs the page asks for.

    `measure` takes the number of runs, a seed (the same gives the same runs) and a progress.
    """

    name: str
    what: str
    runs: int
    measure: Callable[[int, int, Progress], list[Row]]


@dataclass(frozen=True, slots=True)
class Measured:
    """The rows of a harm, with the command that makes them and how long it took (s)."""

    name: str
    command: str
    seconds: float
    rows: tuple[Row, ...]

    @property
    def held(self) -> bool:
        """Whether every row held."""
        return all(row.held for row in self.rows)


def measured(harm: Harm, runs: int, seed: int, progress: Progress = lambda done: None) -> Measured:
    """Do a harm so many times."""
    begin = time.perf_counter()
    rows = tuple(harm.measure(runs, seed, progress))
    command = f"python -m benchmarks.torture {harm.name} --runs {runs} --seed {seed}"
    return Measured(harm.name, command, round(time.perf_counter() - begin, 1), rows)
