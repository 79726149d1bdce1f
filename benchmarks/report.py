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


def times(rates: Mapping[str, float], peer: str, least: float) -> Goal:
    """A speed to reach, as a multiple of a peer's."""
    return Goal(f"{least:g} x {peer}", rates[OURS] / rates[peer], least)


@dataclass(frozen=True, slots=True)
class Row:
    """One work, measured beside its peers in the same rounds.

    `unit` is that of `ours` and of the `peers` (name -> figure). A row that failed has no figure
    of ours, and says why in `note`.
    """

    name: str
    work: str
    unit: str = ""
    ours: float | None = None
    peers: dict[str, float] = field(default_factory=dict)
    goals: tuple[Goal, ...] = ()
    note: str = ""


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


def as_markdown(rows: Sequence[Row], on: str) -> str:
    """The table with ratios, and the machine."""
    lines = ["| work | bilprov | bilprov is | reach |", "|---|---|---|---|"]
    lines += [f"| {' | '.join(cells(row))} |" for row in rows]
    return "\n".join([*lines, "", f"Measured {on}", ""])


def cells(row: Row) -> list[str]:
    """What the table shows of a row: work, figure, multiples of the peers', goals."""
    if row.ours is None:
        return [row.work, "", "", f"failed: {one_cell(row.note)}"]
    ratios = [f"{_short(row.ours / one)} x {name}" for name, one in row.peers.items() if one]
    goals = "; ".join(_reach(goal) for goal in row.goals)
    return [row.work, _figure(row.ours, row.unit), "; ".join(ratios), goals]


def _reach(goal: Goal) -> str:
    """A goal, and whether it is reached: `400 x construct: no, 2.1`."""
    reached = goal.got <= goal.limit if goal.at_most else goal.got >= goal.limit
    return f"{goal.text}: {'yes' if reached else '**no**'}, {_short(goal.got)}"


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
