"""The bench's result: rows with their peers and goals, as a Markdown table."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

OURS = "bilprov"
CONSTRUCT = "construct"
C_LOOP = "C loop"

_LIBRARIES = ("construct", "mcap", "numpy", "msgspec", "zstandard", "click", "rich")
_BEGIN, _END = "<!-- bench -->", "<!-- /bench -->"


@dataclass(frozen=True, slots=True)
class Goal:
    """One thing to reach: `got` is at least `limit`, or at most it with `at_most`."""

    text: str
    got: float
    limit: float
    at_most: bool = False

    @property
    def reached(self) -> bool:
        """Whether it is reached."""
        return self.got <= self.limit if self.at_most else self.got >= self.limit


def times(rates: Mapping[str, float], peer: str, least: float) -> Goal:
    """A speed to reach, as a multiple of a peer's."""
    return Goal(f"{least:g} x {peer}", rates[OURS] / rates[peer], least)


@dataclass(frozen=True, slots=True)
class Row:
    """One work, measured beside its peers in the same rounds.

    `unit` is that of `ours` and of the `peers` (name -> figure). `figures` are others of ours,
    `beside` others of the peers, their unit in the name. A row that failed has
    no figure of ours, and says why in `note`.
    """

    name: str
    work: str
    unit: str = ""
    ours: float | None = None
    peers: dict[str, float] = field(default_factory=dict)
    figures: dict[str, float] = field(default_factory=dict)
    beside: dict[str, float] = field(default_factory=dict)
    goals: tuple[Goal, ...] = ()
    note: str = ""

    @property
    def ratios(self) -> dict[str, float]:
        """Our figure as a multiple of each peer's."""
        if self.ours is None:
            return {}
        return {name: self.ours / figure for name, figure in self.peers.items() if figure}


def machine() -> str:
    """When, where and with what it is measured, the load average before it begins included."""
    cpuinfo = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    cpus = re.findall(r"^model name\s*: (.+)$", cpuinfo, re.MULTILINE)
    libraries = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    compiler = subprocess.run(["cc", "--version"], capture_output=True, text=True, check=True)
    return (
        f"{time.strftime('%Y-%m-%d %H:%M:%S %z')}: {cpus[0] if cpus else platform.machine()}, "
        f"{len(os.sched_getaffinity(0))} cores, {platform.system()} {platform.release()}, load "
        f"{os.getloadavg()[0]:.3g} before; Python {platform.python_version()}, {libraries}, "
        f"{compiler.stdout.partition(chr(10))[0]}."
    )


def as_markdown(rows: Sequence[Row], on: str, *, short: bool = False) -> str:
    """The table with ratios, and the machine; `short` leaves the peers' figures out."""
    head = ["work", "bilprov", *([] if short else ["beside it, same run"]), "bilprov is", "reach"]
    lines = [
        f"| {' | '.join(head)} |",
        f"|{'---|' * len(head)}",
        *(f"| {' | '.join(cells(row, short))} |" for row in rows),
    ]
    return "\n".join([*lines, "", f"Measured {on}", ""])


def cells(row: Row, short: bool = False) -> list[str]:
    """What the table shows of a row: work, figures, peers, ratios and what was to be reached."""
    if row.ours is None:
        return [row.work, "", *([] if short else [""]), "", f"failed: {one_cell(row.note)}"]
    ratios = "; ".join(f"{_short(ratio)} x {name}" for name, ratio in row.ratios.items())
    goals = "; ".join(_reach(goal) for goal in row.goals)
    if short:
        return [row.work, _figure(row.ours, row.unit), ratios, goals]
    ours = "; ".join([_figure(row.ours, row.unit), *_figures(row.figures)])
    peers = [f"{name} {_figure(value, row.unit)}" for name, value in row.peers.items()]
    told = f" ({one_cell(row.note)})" if row.note else ""
    return [row.work + told, ours, "; ".join([*peers, *_figures(row.beside)]), ratios, goals]


def _figures(figures: dict[str, float]) -> list[str]:
    return [_figure(value, name) for name, value in figures.items()]


def _reach(goal: Goal) -> str:
    """A goal, and whether it is reached: `400 x construct: no, 2.1`."""
    return f"{goal.text}: {'yes' if goal.reached else '**no**'}, {_short(goal.got)}"


def _figure(value: float, unit: str) -> str:
    """A figure with its unit: `28.8 k frames/s`."""
    for limit, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if abs(value) >= limit:
            return f"{_short(value / (1e3 if letter == 'k' else limit))} {letter} {unit}"
    return f"{_short(value)} {unit}"


def _short(value: float) -> str:
    """Three digits, more only where they stand before the point."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def one_cell(text: str) -> str:
    """A text as a cell of a table."""
    return " ".join(text.split()).replace("|", "\\|")


def between_markers(text: str, table: str) -> str:
    """The page's text with the table between its markers. Raises ValueError without them."""
    head, begin, rest = text.partition(_BEGIN)
    _, end, tail = rest.partition(_END)
    if not begin or not end:
        raise ValueError(f"there is no {_BEGIN} ... {_END} to write the table into")
    return f"{head}{begin}\n{table}{end}{tail}"
