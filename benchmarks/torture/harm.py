"""A harm that is done to the product again and again, and the rows and the section it gives."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from rich.console import Console
from rich.progress import track

from benchmarks.report import one_cell

T = TypeVar("T")


def tracked(work: Iterable[T], total: int) -> Iterable[T]:
    """The same; on a terminal a bar shows meanwhile how much of the `total` is done."""
    errors, no_bar = Console(stderr=True), not sys.stderr.isatty()
    return track(work, "", total, console=errors, transient=True, disable=no_bar)


@dataclass(frozen=True, slots=True)
class Row:
    """The result of one kind of harm: how often it was done, what was lost, whether all held."""

    harm: str
    times: int
    lost: str
    wrong: tuple[str, ...] = ()
    """What went otherwise than it may, a sentence each."""

    @property
    def held(self) -> bool:
        """Whether nothing went otherwise than it may."""
        return not self.wrong


@dataclass(frozen=True, slots=True)
class Harm:
    """A harm: its name on the command line, what it does, how many runs the page asks for.

    `measure` takes the number of runs and a seed; the same gives the same runs.
    """

    name: str
    what: str
    runs: int
    measure: Callable[[int, int], list[Row]]

    @property
    def title(self) -> str:
        """The title of its section."""
        return f"{self.what[0].upper()}{self.what[1:]}"

    def section(self, rows: Sequence[Row], options: str, seconds: float) -> str:
        """Its section of docs/RELIABILITY.md: the rows, and the command that made them."""
        lines = [self.title, "", "| harm | times | what was lost | held |", "|---|---|---|---|"]
        for row in rows:
            cells = (row.harm, f"{row.times:,}", row.lost, "yes" if row.held else "**no**")
            lines.append(f"| {' | '.join(map(one_cell, cells))} |")
        took = f"{seconds / 60:.0f} minutes" if seconds > 90 else f"{seconds:.0f} s"
        command = f".venv/bin/python -m benchmarks.torture {self.name} {options}"
        return "\n".join([*lines, "", f"    {command}  # {took}", ""])
