"""Runs all targets, each with its share of the inputs, and says how many of them failed."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from benchmarks.fuzz.engine import Row, Target, run
from benchmarks.fuzz.targets import TARGETS


def measure(
    inputs: int,
    seed: int,
    chosen: Sequence[Target] = tuple(TARGETS.values()),
    progress: Callable[[str, int], object] = lambda name, count: None,
) -> list[Row]:
    """Feed the chosen targets, all of them by default, with so many inputs in all.

    Each row tells a target's inputs, crashes and findings; the same seed gives the same. `progress`
    is told a target's name and how many more inputs are done.
    """
    whole = sum(target.share for target in chosen)
    rows: list[Row] = []
    share = left = inputs
    for number, target in enumerate(chosen):
        share = left if number == len(chosen) - 1 else round(inputs * target.share / whole)
        left -= share

        def told(count: int, name: str = target.name) -> None:
            progress(name, count)

        rows.append(run(target, share, seed, told))
    return rows
