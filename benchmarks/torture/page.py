"""docs/RELIABILITY.md: each harm, how often it was done, what was lost, and the command."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.torture.harm import Measured
from benchmarks.torture.harms import HARMS

_HEAD = """# Reliability

What was done to bilprov, how often, and what was lost. `make torture` does it all again and
writes this page, on two cores in four to five hours; the command under each table does that part
alone. Where something was lost that may not be, the row says **no**. [captures.md](captures.md)
has the limits.
"""


def page(done: Sequence[Measured], before: str = "") -> str:
    """The page with the sections of what was done; of other harms those that `before` has."""
    sections = {part.partition("\n")[0]: part for part in before.split("\n## ")[1:]}
    sections |= {_title(harm.name): _section(harm) for harm in done}
    titles = [_title(name) for name in HARMS]
    return "\n## ".join([_HEAD, *(sections[title] for title in titles if title in sections)])


def _title(name: str) -> str:
    what = HARMS[name].what
    return f"{what[0].upper()}{what[1:]}"


def _section(harm: Measured) -> str:
    lines = [
        _title(harm.name),
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
