"""`python -m benchmarks.torture [HARM ...]`: does the long harms and shows what was lost.

With --page the rows of each harm replace its section of docs/RELIABILITY.md as soon as it is done.
Exits with status 1 if a robot, a message or a verdict was lost that may not be.
"""

from __future__ import annotations

import argparse
import sys
import time

from benchmarks.commands import ROOT, tell
from benchmarks.dispositions import usual_for_children
from benchmarks.torture.harm import Row
from benchmarks.torture.harms import HARMS, page

PAGE = ROOT / "docs" / "RELIABILITY.md"


def main() -> int:
    """Do what the arguments ask for."""
    known = "; ".join(f"{name}: {harm.what} ({harm.runs:,})" for name, harm in HARMS.items())
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("harm", nargs="*", help=f"these only; {known}")
    parser.add_argument("--runs", type=int, metavar="N", help="so often (the figure in brackets)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="what is drawn (1)")
    parser.add_argument("--page", action="store_true", help=f"write docs/{PAGE.name} too")
    given = parser.parse_args()
    if unknown := [name for name in given.harm if name not in HARMS]:
        parser.error(f"there is no harm {unknown[0]!r}, only {', '.join(HARMS)}")
    usual_for_children()
    held = True
    for harm in [HARMS[name] for name in given.harm or HARMS]:
        begun, runs = time.perf_counter(), given.runs or harm.runs
        tell(f"{harm.title}: {runs} runs")
        rows = harm.measure(runs, given.seed)
        _show(rows)
        held &= all(row.held for row in rows)
        if given.page:
            options, took = f"--runs {runs} --seed {given.seed}", time.perf_counter() - begun
            section = harm.section(rows, options, took)
            PAGE.write_text(page({harm.name: section}, PAGE.read_text()))
    return 0 if held else 1


def _show(rows: list[Row]) -> None:
    for row in rows:
        state = "held" if row.held else "WRONG"
        tell(f"{state:5}  {row.times:>9,}  {row.harm}: {row.lost}")
        for sentence in row.wrong:
            tell(f"       {sentence}")


if __name__ == "__main__":
    sys.exit(main())
