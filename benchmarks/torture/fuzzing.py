"""Damaged inputs for everything that reads foreign bytes or text: the targets of `make fuzz`."""

from __future__ import annotations

from benchmarks.fuzz.measure import measure as fuzzed
from benchmarks.torture.harm import Harm, Progress, Row


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    rows = fuzzed(runs, seed, progress=lambda name, done: progress(done))
    return [
        Row(
            f"fuzzed inputs for {row.target}",
            row.inputs,
            f"{row.crashes:,} crashes; {row.refused:,} refused with a sentence",
            tuple(f"{one.failure.error} at {one.failure.where}" for one in row.findings),
        )
        for row in rows
    ]


HARM = Harm("fuzz", "damaged inputs for every reader", 2_500_000, _measure)
