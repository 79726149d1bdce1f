"""`python -m benchmarks.torture [HARM ...]`: does the long harms and says what each came to.

With --page what each came to replaces its section of docs/RELIABILITY.md, as soon as it is done.
Ends with 1 if a robot, a message or a verdict was lost that may
not be.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress

from benchmarks.dispositions import usual_for_children
from benchmarks.torture.harm import Harm, Measured, measured
from benchmarks.torture.harms import HARMS
from benchmarks.torture.page import page

ROOT = Path(__file__).resolve().parent.parent.parent
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
    if given.runs is not None and given.runs < 1:
        parser.error(f"--runs {given.runs}: one at least")
    usual_for_children()
    chosen = [HARMS[name] for name in given.harm or HARMS]
    held = True
    for harm in chosen:
        done = _done(harm, given.runs or harm.runs, given.seed)
        held &= done.held
        if given.page:
            PAGE.write_text(page([done], PAGE.read_text() if PAGE.exists() else ""))
    return 0 if held else 1


def _done(harm: Harm, runs: int, seed: int) -> Measured:
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(harm.name, total=runs)
        done = measured(harm, runs, seed, lambda count: progress.advance(task, count))
    console = Console(highlight=False, soft_wrap=True)
    for row in done.rows:
        state = "held" if row.held else "WRONG"
        console.print(escape(f"{state:5}  {row.times:>9,}  {row.harm}: {row.lost}"))
        for sentence in row.wrong:
            console.print(escape(f"       {sentence}"))
    console.print(f"{harm.name}: {done.seconds:.0f} s")
    return done


if __name__ == "__main__":
    sys.exit(main())
