"""Noise: whether failures that came again may be spoilt bytes on the line after all."""

from __future__ import annotations

from collections.abc import Callable
from math import comb
from typing import NamedTuple

import msgspec

from bilprov.analyzer.client.operations import Procedure
from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.runner.run import Run

_SPOILT, _UNLIKELY = 1e-3, 1e-4  # share of bytes that noise may spoil; what is no chance
_FRAME = 3  # bytes on the line for a frame, its answer included, at least
_TRIES, _MOST = 3, 12  # tries of what failed once, fewest and most
_ENOUGH = 20  # failures: more make nothing surer
_SINGLE = 20  # bytes of a single-frame case's preamble and recovery


class Confirmed(NamedTuple):
    """What the tries after a failure showed: of so many it failed again in `failed`.

    It is `sure` where noise does not explain that.
    """

    sure: bool
    tries: int
    failed: int

    def judged(self, run: Run, axis: Axis) -> Axis:
        """The axis, flaky if it failed and that is not sure; on a lossless line it stays failed."""
        if self.sure or axis.verdict is not Verdict.FAIL:
            return axis
        if not run.config.lossless:
            return axis.uncertain(f"flaky, not reproduced in {self.tries} tries: ")
        times = f"{self.failed + 1} times" if self.failed else "once"
        met = f"met {times} in {self.tries + 1} tries, on a line that loses nothing"
        return msgspec.structs.replace(axis, reason=f"{met}: {axis.reason}")


def confirm(run: Run, size: int, fails: Callable[[], Procedure[bool]]) -> Procedure[Confirmed]:
    """Repeat a trial of `size` bytes that failed, until noise does not explain its failures.

    It is given up where most of the tries do not fail.
    """
    tries = failed = 0
    while tries < _MOST and (tries < _TRIES or 2 * failed > tries):
        failed += yield from fails()
        tries += 1
        if failed > 1 and is_no_chance(run, size, failed, tries):
            return Confirmed(True, tries, failed)
    return Confirmed(False, tries, failed)


def is_no_lie(run: Run, looks: int, failed: int, tries: int) -> bool:
    """Whether wrong looks, among so many in a try, do not explain that so many tries failed."""
    wrong, enough = 1 - (1 - run.looks.wrong) ** looks, min(failed, _ENOUGH)
    return comb(tries, enough) * wrong**enough < _UNLIKELY


def is_no_chance(run: Run, size: int, differed: int, tries: int) -> bool:
    """Whether spoilt bytes among `size` do not explain that so many of so many tries differed.

    The share of bytes that are spoilt is what the run has met so far, at least the most that the
    suite bears; and each failure so far was tried again, which makes a coincidence likelier.
    """
    flaky = run.counters.flaky
    met = 2 * flaky / max(1, _FRAME * run.answers)
    spoilt = 1 - (1 - min(max(_SPOILT, met), 1.0)) ** size
    return at_least(differed, tries, spoilt) * (1 + flaky) < _UNLIKELY


def at_least(count: int, tries: int, chance: float) -> float:
    """The probability that at least `count` of `tries` happen, each with probability `chance`."""
    return sum(
        comb(tries, n) * chance**n * (1 - chance) ** (tries - n) for n in range(count, tries + 1)
    )


def case_bytes(case: Case | SequenceCase) -> int:
    """Bytes on the line in one try, answers included; an estimate for a single-frame case."""
    if isinstance(case, SequenceCase):
        return sum(len(step.frame) + 1 for step in (*case.setup, *case.steps))
    return _SINGLE + sum(map(len, case.sent))
