"""`python -m benchmarks.fuzz`: feeds every target with damaged inputs; ends with 1 if one fails.

What a target fails on is shortened and written to build/fuzz; the line that replays it is printed.
"""

from __future__ import annotations

import argparse
import sys
import zlib
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.fuzz.engine import Failed, Finding, Target, outcome_of, watched
from benchmarks.fuzz.targets import TARGETS, measure

OUT = Path(__file__).resolve().parent.parent.parent / "build" / "fuzz"
_SHOWN = 120  # bytes of a finding


def main() -> int:
    """Run what the arguments ask for."""
    known = "only " + ", ".join(f"{one.name} ({one.holds})" for one in TARGETS.values())
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=200_000, help="in all (200000)")
    parser.add_argument("--seed", type=int, default=1, help="the same gives the same inputs (1)")
    parser.add_argument(
        "--target", action="append", choices=list(TARGETS), help=known, metavar="NAME"
    )
    parser.add_argument("--replay", metavar="FILE", help="one input, for one --target")
    options = parser.parse_args()
    chosen = [TARGETS[name] for name in options.target or TARGETS]
    if options.replay:
        if not options.target or len(chosen) != 1:
            parser.error("--replay is for one target: say which with --target")
        return _replay(chosen[0], Path(options.replay))
    return _run(chosen, options.inputs, options.seed)


def _run(chosen: Sequence[Target], inputs: int, seed: int) -> int:
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("inputs", total=inputs)
        rows = measure(inputs, seed, chosen, lambda done: progress.advance(task, done))
    table = Table("target", "inputs", "seconds", "refused", "outcomes", "crashes", "findings")
    for row in rows:
        numbers = (row.refused, row.outcomes, row.crashes, len(row.findings))
        cells = (f"{row.inputs:,}", f"{row.seconds:.1f}", *(f"{n:,}" for n in numbers))
        table.add_row(row.target, *cells)
    Console(highlight=False).print(table)
    findings = [finding for row in rows for finding in row.findings]
    for finding in findings:
        _tell(finding)
    return int(bool(findings))


def _tell(finding: Finding) -> None:
    OUT.mkdir(parents=True, exist_ok=True)
    file = OUT / f"{finding.target}-{zlib.crc32(finding.data):08x}"
    file.write_bytes(finding.data)
    shown = finding.data[:_SHOWN].hex() + ("..." if len(finding.data) > _SHOWN else "")
    sys.stdout.write(
        f"\n{finding.target}: {finding.failure.error} at {finding.failure.where}, "
        f"{finding.times} times\n  {len(finding.data)} bytes: {shown}\n"
        f"  again: {sys.executable} -m benchmarks.fuzz --target {finding.target} --replay {file}\n"
    )


def _replay(target: Target, file: Path) -> int:
    with watched():
        outcome = outcome_of(target, target.prepare(), file.read_bytes())
    sys.stdout.write(f"{outcome.said if isinstance(outcome, Failed) else outcome}\n")
    return int(isinstance(outcome, Failed))


if __name__ == "__main__":
    sys.exit(main())
