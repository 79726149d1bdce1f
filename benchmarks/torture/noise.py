"""The suite over lines that drop, flip and double bytes: no good robot fails, no faulty one passes.

A run is one seed: the simulator, and a fault of its bank, each over the same kind of line with the
same share of bad bytes, at level standard in virtual time (`benchmarks.noise`).
"""

from __future__ import annotations

from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

from benchmarks.noise import Trial, noisy_run, simulated
from benchmarks.torture.harm import Harm, Progress, Row
from benchmarks.torture.robots import verdicts

RATES = (1e-3, 3e-4, 1e-4)
"""Shares of bad bytes."""


class Ended(NamedTuple):
    """How a trial ended: its exit code, and what it told."""

    trial: Trial
    code: int
    told: str

    @property
    def wrong(self) -> str:
        """What went otherwise than it may, "" if nothing did."""
        if self.code in self.trial.expected:
            return ""
        what = self.trial.fault or "the reference"
        return f"{what}, seed {self.trial.seed}: exit {self.code}: {self.told}"


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    """Run so many seeds in two processes; a row for each kind of line and rate."""
    trials = simulated(range(seed, seed + runs), RATES)
    rows = defaultdict[tuple[str, float], list[Ended]](list)
    with ProcessPoolExecutor(2) as pool:
        for trial, ended in zip(trials, pool.map(noisy_run, trials), strict=True):
            rows[trial.line, trial.rate].append(Ended(trial, *ended))
            progress(int(not trial.fault))  # a run is two trials
    return [_row(f"bytes {line} at {rate:g}", ended) for (line, rate), ended in rows.items()]


def _row(line: str, ended: list[Ended]) -> Row:
    return Row(
        f"the suite with {line}",
        len(ended),
        verdicts((not one.trial.fault, one.code) for one in ended),
        tuple(one.wrong for one in ended if one.wrong),
    )


HARM = Harm("noise", "the suite over lines that hurt bytes", 200, _measure)
