"""Judges a case: tries it, tries it again if it failed, and shortens what fails for good.

A mismatch on a line may be noise. Reproduced twice it is a failure; otherwise it is flaky, which is
inconclusive and never a pass. A fault that shows only now and then (a counter) is tried more often.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from math import comb

import msgspec

from conformance.cases.sequence import Burst, Mismatch, Walk
from conformance.cases.single_frames import Case
from conformance.dut.operations import Script
from conformance.oracle.verdicts import Axis, CaseResult, Verdict
from conformance.runner.homing import home
from conformance.runner.run import Run
from conformance.runner.sequence import walk
from conformance.runner.single_frame import try_case
from spec.codec import spaced

_TRIES, _TWICE = 3, 2
_MORE, _OFTEN = 24, 3  # what does not show each time: tried so often, shown so often
_BYTES = 8000  # that more tries may cost
_NOISE, _UNLIKELY = 2e-4, 0.005  # bytes spoilt on a line that may still be used; what is no chance
_SINGLE = 20  # bytes of a case's set-up and recovery
_FLAKY = 8
_TRUSTED = 6  # failures reproduced, and nothing flaky: the line is good and the device is not
_SHRUNK, _SHORTER = 5, 60  # walks that are shortened in a run, tries for each


@dataclass(frozen=True, slots=True)
class _Try:
    """One try of a case: its result, and where and how it went wrong."""

    result: CaseResult
    mismatch: Mismatch | None

    @property
    def failed(self) -> bool:
        return self.result.verdict is Verdict.FAIL

    @property
    def axis(self) -> str:
        """The axis that failed."""
        return self.how.partition(":")[0]

    @property
    def how(self) -> str:
        """How it failed, without the numbers."""
        name, axis = max(self.result.axes.items(), key=lambda item: item[1].verdict)
        return f"{name}: {re.sub(r'[0-9]+', '#', axis.reason)}"

    @property
    def where(self) -> tuple[int, str]:
        """Where and how it failed."""
        return (self.mismatch.burst if self.mismatch else 0), self.how


def judge_case(run: Run, case: Case | Walk) -> Script[None]:
    """Try a case, reproduce what fails, and report it. Leaves the line homed."""
    allowed = run.profile.choices.allowed
    if "pipelining" in allowed and isinstance(case, Walk) and case.pipelined:
        run.end(case, {"answer": Axis(Verdict.SKIPPED, "", "not run", "allowed: pipelining=no")})
        return
    first = yield from _try(run, case)
    if not first.failed:
        run.publish(first.result)
        return
    if run.reproduced >= _TRUSTED and not run.flaky:
        run.publish(_named(case, first))
        return
    run.suspect = first.result
    hits, tries = yield from _again(run, case, first)
    if not hits and not _cannot_be_noise(run, first):
        run.suspect = None
        run.flaky += 1
        run.publish(_flaky(first.result, tries))
        return
    run.reproduced += 1
    # A run that ends while the walk is shortened still has this failure.
    run.suspect = result = _named(case, first)
    if isinstance(case, Walk) and first.mismatch:
        shorter = case
        if run.shrunk < _SHRUNK:
            run.shrunk += 1
            shorter = yield from _shrink(run, case, first)
        else:
            shorter = _up_to(case, first.mismatch)
        sent = tuple(spaced(data) for data in shorter.sent)
        result = msgspec.structs.replace(result, sent=sent, reproduce=reproducer(run, shorter))
    run.suspect = None
    run.publish(result)


def _try(run: Run, case: Case | Walk) -> Script[_Try]:
    """One try, homed afterwards; what is charged to it while homing counts."""
    run.trying = []
    mismatch = None
    if isinstance(case, Walk):
        mismatch = yield from walk(run, case)
    else:
        yield from try_case(run, case)
    yield from home(run)
    return _Try(run.tried(case.id), mismatch)


def _again(run: Run, case: Case | Walk, first: _Try) -> Script[tuple[bool, int]]:
    """Whether the failure is reproduced, and in how many tries that was found out."""
    hits = alike = tries = 0
    size = _bytes(case)
    # A byte that is spoilt shows in an answer: a missed stop beside the right ones is no noise.
    spoilt = 0 if first.axis == "stop" else 1 - (1 - _NOISE) ** size
    # Where the line was flaky before, what goes wrong alike but elsewhere may be its doing again.
    often = _OFTEN + min(run.flaky, _OFTEN)
    # A line that is flaky throughout is not tried for so long each time.
    most = _TRIES if run.flaky >= _FLAKY else max(_TRIES + 1, min(_MORE, _BYTES // size))
    while tries < most:
        again = yield from _try(run, case)
        tries += 1
        if again.failed:
            hits += again.where == first.where
            alike += again.how == first.how
        if tries <= _TRIES and hits >= _TWICE:
            return True, tries
        # A long walk is spoilt more often than a short one, and then anywhere.
        if alike >= often and _at_least(alike, tries, spoilt) < _UNLIKELY:
            return True, tries
        if tries >= _TRIES and alike + (most - tries) < often:
            break
    return False, tries


def _bytes(case: Case | Walk) -> int:
    """How many bytes go over the line in a try, answers included; about so many for a case."""
    if isinstance(case, Walk):
        return sum(len(step.frame) + 1 for step in (*case.setup, *case.steps))
    return _SINGLE + len(case.stimulus)


def _at_least(count: int, tries: int, chance: float) -> float:
    """How likely that many of so many tries are, each with that chance."""
    return sum(
        comb(tries, n) * chance**n * (1 - chance) ** (tries - n) for n in range(count, tries + 1)
    )


def _cannot_be_noise(run: Run, tried: _Try) -> bool:
    """Whether a stop was missed for the second time although every answer was right.

    A byte that the line has changed shows in an answer too; a stop that fails beside the right
    answers is the device's, also if it does so only now and then.
    """
    axes = tried.result.axes
    answer, stop = axes.get("answer"), axes.get("stop")
    if answer is None or stop is None:
        return False
    if answer.verdict >= Verdict.INCONCLUSIVE or stop.verdict is not Verdict.FAIL:
        return False
    run.missed_stops += 1
    return run.missed_stops > 1


def _up_to(case: Walk, mismatch: Mismatch) -> Walk:
    """The walk as far as it went."""
    return replace(case, bursts=case.bursts[: max(0, mismatch.burst) + 1])


def _named(case: Case | Walk, tried: _Try) -> CaseResult:
    """The result with the clause that the failing step breaks, and what was sent until then."""
    if tried.mismatch is None or not isinstance(case, Walk):
        return tried.result
    sent = tuple(spaced(data) for data in _up_to(case, tried.mismatch).sent)
    step = tried.mismatch.step
    name, axis = tried.mismatch.name, tried.mismatch.axis
    what = f"burst {tried.mismatch.burst + 1}, frame {spaced(step.frame)}: {axis.reason}"
    told = Axis(axis.verdict, axis.expected, axis.actual, what, axis.reading)
    axes = tried.result.axes | {name: told}
    clause = tried.mismatch.clause
    return msgspec.structs.replace(tried.result, axes=axes, clause=clause, sent=sent)


def _flaky(result: CaseResult, tries: int) -> CaseResult:
    """The result as inconclusive: what failed once and was not reproduced."""
    axes = {
        name: Axis(
            Verdict.INCONCLUSIVE,
            axis.expected,
            axis.actual,
            f"flaky, not reproduced in {tries} tries: {axis.reason}",
            axis.reading,
        )
        if axis.verdict is Verdict.FAIL
        else axis
        for name, axis in result.axes.items()
    }
    return msgspec.structs.replace(result, verdict=Verdict.INCONCLUSIVE, axes=axes)


def _shrink(run: Run, case: Walk, first: _Try) -> Script[Walk]:
    """The shortest walk found that still goes wrong on the same axis.

    Bursts are left out, first many at a time, then frames of what is left. The set-up stays: what
    the robot was before is not what it is when it is switched on.
    """
    assert first.mismatch is not None
    last = first.mismatch.burst
    if last < 0:
        begun = case.setup[: len(case.setup) + last + 1]
        return replace(case, setup=(), bursts=tuple(Burst((step,)) for step in begun))
    best = replace(case, bursts=case.bursts[: last + 1])
    size, left = max(1, len(best.bursts) // 2), _SHORTER
    while left > 0:
        for shorter in (*_without_bursts(best, size), *(_without_steps(best) if size == 1 else ())):
            left -= 1
            tried = yield from _try(run, shorter)
            end = tried.mismatch.burst + 1 if tried.mismatch else len(shorter.bursts)
            if tried.failed and end > 0 and tried.axis == first.axis:
                best = replace(shorter, bursts=shorter.bursts[:end])
                size = max(1, min(size, len(best.bursts) // 2))
                break
            if left <= 0:
                break
        else:
            if size == 1:
                break
            size //= 2
    return best


def _without_bursts(walk: Walk, size: int) -> Iterator[Walk]:
    """The walk without each run of `size` bursts, the last ones first."""
    for end in range(len(walk.bursts), 0, -size):
        left = walk.bursts[: max(0, end - size)] + walk.bursts[end:]
        if left:
            yield replace(walk, bursts=left)


def _without_steps(walk: Walk) -> Iterator[Walk]:
    """The walk without each frame of its bursts of several; pauses inside a burst go with it."""
    for at, burst in enumerate(walk.bursts):
        for index in range(len(burst.steps) if len(burst.steps) > 1 else 0):
            steps = burst.steps[:index] + burst.steps[index + 1 :]
            pauses = burst.pauses if index == len(burst.steps) - 1 else ()
            fewer = replace(burst, steps=steps, pauses=pauses)
            yield replace(walk, bursts=(*walk.bursts[:at], fewer, *walk.bursts[at + 1 :]))


def reproducer(run: Run, case: Walk) -> str:
    """What `bilprov send` is given to do the same: each burst's bytes, and pauses where needed."""
    bursts = (*(Burst((step,)) for step in case.setup), *case.bursts)
    words: list[str] = []
    split = any(burst.pauses for burst in bursts)
    gap = max(1, run.timeout // 16_000_000)
    for burst in bursts:
        data = burst.data
        places = [0, *(p for p in burst.pauses if p < len(data)), len(data)]
        for start, end in pairwise(places):
            words += [f"pause={gap}"] if start else []
            words.append(data[start:end].hex())
        if split and burst is not bursts[-1]:
            words.append(f"pause={run.usual // 1_000_000}")
    return " ".join((["--together"] if split else []) + words)
