"""The table of all targets, and their shares of the inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from benchmarks.fuzz import captures, editing, reports, texts, traffic
from benchmarks.fuzz.engine import Row, Target, run

TARGETS: dict[str, Target] = {
    target.name: target
    for module in (traffic, texts, captures, editing, reports)
    for target in module.TARGETS
}
"""Every target by its name."""


def measure(
    inputs: int,
    seed: int,
    chosen: Sequence[Target] = tuple(TARGETS.values()),
    progress: Callable[[int], object] = lambda count: None,
) -> list[Row]:
    """Feed the chosen targets, all of them by default, with so many inputs in all.

    The same seed gives the same inputs. `progress` is called with how many more are done.
    """
    whole, done, ended = sum(target.share for target in chosen), 0, 0.0
    rows = []
    for target in chosen:
        ended += target.share
        share = round(inputs * ended / whole) - done
        rows.append(run(target, share, seed, progress))
        done += share
    return rows
