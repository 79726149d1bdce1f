"""The suite over lines that drop, flip and double bytes: no good robot fails, no faulty one passes.

A run is one seed: the simulator, and a fault of its bank, each over the same kind of line with the
same share of bad bytes, at level standard in virtual time (`benchmarks.noise`).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from concurrent.futures import ProcessPoolExecutor

from benchmarks.noise import Trial, noisy_run, simulated
from benchmarks.torture.harm import Harm, Progress, Row

RATES = (1e-3, 3e-4, 1e-4)
"""Shares of bad bytes."""


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    """Run so many seeds in two processes; a row for each kind of line and rate."""
    trials = simulated(range(seed, seed + runs), RATES)
    rows = defaultdict[str, list[tuple[Trial, int, str]]](list)
    with ProcessPoolExecutor(2) as pool:
        for trial, ended in zip(trials, pool.map(noisy_run, trials), strict=True):
            rows[f"bytes {trial.line} at {trial.rate:g}"].append((trial, *ended))
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


HARM = Harm("noise", "the suite over lines that hurt bytes", 200, _measure)
