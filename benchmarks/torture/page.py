"""docs/RELIABILITY.md: each harm, how often it was done, what was lost, and the command."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.torture.harm import Measured
from benchmarks.torture.harms import HARMS

_HEAD = """# Reliability

What was done to bilprov, how often, and what was lost. `make torture` does it all again and
writes this page, on two cores in some three hours; the command under each table does that part
alone. Where something was lost that may not be, the row says **no**. [captures.md](captures.md)
has the limits.
"""


def page(harms: Sequence[Measured]) -> str:
    """The page, from the rows of every harm."""
    return "\n".join([_HEAD, *(_section(harm) for harm in harms)])


def _section(harm: Measured) -> str:
    what = HARMS[harm.name].what
    lines = [
        f"## {what[0].upper()}{what[1:]}",
        "",
        "| harm | times | what was lost | held |",
        "|---|---|---|---|",
    ]
    for row in harm.rows:
        held = "yes" if row.held else "**no**"
        lines.append(f"| {_cell(row.harm)} | {row.times:,} | {_cell(row.lost)} | {held} |")
    took = f"{harm.seconds / 60:.0f} minutes" if harm.seconds > 90 else f"{harm.seconds:.0f} s"
    return "\n".join([*lines, "", f"    .venv/bin/{harm.command}  # {took}", ""])


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
