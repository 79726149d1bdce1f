"""The suite over lines that drop, flip and double bytes: no good robot fails, no faulty one passes.

A run is one seed: a good device, and a faulty one, each over the same kind of line, at level
standard in virtual time (`benchmarks.noise`).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.noise import Trial, boards, noisy_run, simulated
from benchmarks.torture.harm import Harm, Progress, Row

RATES = (1e-3, 3e-4, 1e-4)
"""Shares of bad bytes."""


def _simulators(runs: int, seed: int, progress: Progress) -> list[Row]:
    """Run so many seeds of the simulator; a row for each kind of line and rate."""
    return _rows(simulated(range(seed, seed + runs), RATES), progress)


def _boards(runs: int, seed: int, progress: Progress) -> list[Row]:
    """Run so many seeds of the firmware."""
    with TemporaryDirectory() as folder:
        return _rows(boards(range(seed, seed + runs), Path(folder)), progress)


def _rows(trials: Iterable[Trial], progress: Progress) -> list[Row]:
    """Make the runs in two processes."""
    rows = defaultdict[str, list[tuple[Trial, int, str]]](list)
    with ProcessPoolExecutor(2) as pool:
        for trial, ended in zip(trials, pool.map(noisy_run, trials), strict=True):
            rows[trial.told].append((trial, *ended))
            progress(int(not trial.fault))  # a run is two trials
    return [_row(line, ended) for line, ended in rows.items()]


def _row(line: str, ended: list[tuple[Trial, int, str]]) -> Row:
    codes = Counter((trial.fault != "", code) for trial, code, _ in ended)
    shown = ", ".join(
        f"{'faulty' if faulty else 'good'}: exit {code} in {times}"
        for (faulty, code), times in sorted(codes.items())
    )
    return Row(
        f"the suite with {line}",
        len(ended),
        f"{codes[False, 1]} good robots failed, {codes[True, 0]} faulty ones passed ({shown})",
        tuple(
            f"{trial.fault or 'the reference'}, seed {trial.seed}: exit {code}: {reason}"
            for trial, code, reason in ended
            if code not in trial.expected
        ),
    )


HARM = Harm("noise", "the suite over lines that hurt bytes", 200, _simulators)
BOARD = Harm("board", "the suite with the firmware over a line that hurts bytes", 50, _boards)
