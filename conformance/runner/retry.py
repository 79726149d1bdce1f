"""Attempts a case, and again if it failed: it counts as failed only if the failure is reproduced.

A mismatch on a line may be noise. Reproduced twice in three tries it is a failure; otherwise it is
flaky, that is inconclusive and never a pass; a line that loses nothing has no noise, and there it
is a failure all the same. A fault that shows only now and then (a counter) is tried more often.
Reproduced failures of a sequence are minimised to a short one that still fails, of which the
reproducer is written. `confirm` repeats the first exchanges after power-on as well.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import comb
from typing import Any, NamedTuple, Protocol, TypeVar

import msgspec

from bilprov.analyzer.client.operations import Ended, Procedure, Reconnected
from bilprov.captures.text import quantity
from bilprov.conformance.cases.case import Case, OrderCase, steps_to
from bilprov.conformance.cases.sequence import Burst, SequenceCase
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict
from bilprov.conformance.runner.homing import home_after, was_too_slow
from bilprov.conformance.runner.run import SPOILT, Homed, Run, Trial, result_of
from bilprov.conformance.runner.sequence import Mismatch, run_sequence
from bilprov.conformance.runner.single_frame import run_single_frame
from bilprov.conformance.runner.waiting import GaveUp
from bilprov.conformance.runner.wheel_order import run_wheel_order
from bilprov.spec.codec import spaced


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt at a case: its result, and the mismatch where a sequence failed.

    `stopped` is what ended the run, or why it is to be ended, None if nothing. `looks`
    is how many looks were made in it. `already` is how the state that failed was wrong before the
    frame under test, "" if it was not.
    """

    result: CaseResult
    mismatch: Mismatch | None = None
    stopped: Ended | GaveUp | None = None
    looks: int = 0
    already: str = ""

    @property
    def failed(self) -> bool:
        """Whether the case failed in this attempt."""
        return self.result.verdict is Verdict.FAIL

    @property
    def held_up(self) -> bool:
        """Whether line or device stood still for a moment where it failed."""
        return self.mismatch is not None and self.mismatch.held_up

    @property
    def axis(self) -> str:
        """The axis that failed."""
        return self.how.partition(":")[0]

    @property
    def how(self) -> str:
        """How it failed: the worst axis and its reason, with each number as #."""
        name, axis = max(self.result.axes.items(), key=lambda item: item[1].verdict)
        return f"{name}: {re.sub(r'[0-9]+', '#', axis.reason)}"

    @property
    def where(self) -> tuple[int, str]:
        """Where and how it failed: the burst's index (0 for a single frame), and `how`."""
        return (self.mismatch.burst if self.mismatch else 0), self.how


def attempt(run: Run, case: Case | SequenceCase) -> Procedure[Attempt]:
    """Attempt a case once: preamble, stimulus, checks, then homing, which shows late answers too.

    An attempt that was stopped, by the user, the link or the device, has a result too: what passed
    so far is then no pass.
    """
    trial, mismatch = Trial(run, case), None
    looks = run.looks.made
    try:
        if isinstance(case, SequenceCase):
            mismatch = yield from run_sequence(trial, case)
        elif isinstance(case, OrderCase):
            yield from run_wheel_order(trial, case)
        else:
            yield from run_single_frame(trial, case)
    except Ended as ended:
        homed = Homed(stopped=ended)
    else:
        homed = yield from home_after(run, trial)
    result = trial.end(homed)
    return Attempt(result, mismatch, homed.stopped, run.looks.made - looks, trial.already)


_TRIES, _TWICE = 3, 2
FEW = _TRIES + 1
"""The least number of tries `most` of `confirm`: what failed in three of four is no noise."""
_MORE, _OFTEN = 24, 3  # for a failure that does not show each time: most tries, failures needed
_BYTES = 8000  # most bytes on the line for all tries of a case
_FLAKY = 8
TRUSTED = 6  # failures reproduced, none flaky: the line is good, no more retries


class _Stopped(Exception):
    """A retry was stopped; carries that attempt."""

    def __init__(self, last: Attempt) -> None:
        super().__init__(last.stopped)
        self.last = last


def judge_case(run: Run, case: Case | SequenceCase) -> Procedure[Attempt]:
    """Attempt a case, and a failure again; returns the attempt with the case's final result.

    Leaves the line homed.
    """
    allowed = run.profile.choices.allowed
    if "pipelining" in allowed and isinstance(case, SequenceCase) and case.pipelined:
        axis = Axis(Verdict.SKIPPED, "", "not run", "allowed: pipelining=no")
        return Attempt(result_of(case, {"answer": axis}))
    if isinstance(case, SequenceCase) and (missing := set(case.facets) - run.profile.facets):
        why = f"no probe reports the robot's {' and '.join(sorted(missing))}"
        return Attempt(result_of(case, {"answer": Axis(Verdict.SKIPPED, "", "not run", why)}))
    first = yield from attempt(run, case)
    if first.stopped or not first.failed:
        return first
    if run.line.explains(first.result):  # over such a line it would not tell more another time
        return Attempt(_placed(case, first))
    answer = first.result.axes.get("answer")
    # How fast the wheels turn explains no wrong answer.
    if isinstance(case, Case) and (answer is None or answer.verdict < Verdict.INCONCLUSIVE):
        try:
            too_slow = yield from was_too_slow(run, case)
        except Reconnected as gap:
            return replace(
                first, result=first.result.uncertain(after=f"; not tried again: {gap}"), stopped=gap
            )
        except (Ended, GaveUp) as stopped:
            return replace(first, stopped=stopped)
        if too_slow:
            return (yield from judge_case(run, case))
    trusted = run.counters.reproduced >= TRUSTED and not run.counters.flaky
    if trusted and not first.held_up:
        return Attempt(_placed(case, first))
    known = _placed(case, first) if run.config.lossless else first.result
    confirmed = False
    try:
        again = yield from confirm(run, case, first, lambda: _retry(run, case))
        if not again.sure and (run.config.lossless or not _cannot_be_noise(run, first)):
            run.counters.reproduced += run.config.lossless
            run.counters.flaky += not run.config.lossless
            return Attempt(again.judged(run, known))
        run.counters.reproduced += 1
        known, confirmed = _placed(case, first), True
        if isinstance(case, SequenceCase) and first.mismatch:
            shorter = yield from _shortened(run, case, first, first.mismatch)
            place = replace(first.mismatch, burst=len(shorter.bursts) - 1)
            known = _placed(shorter, replace(first, mismatch=place))
            known = msgspec.structs.replace(known, reproduce=reproducer(run, shorter))
    except _Stopped as stopped:
        # An interruption leaves the failure that is known; where the device made the rest
        # pointless, the last attempt shows why.
        last = stopped.last
        if isinstance(last.stopped, Reconnected) and not confirmed:
            known = known.uncertain(after=f"; not tried again: {last.stopped}")
        return replace(last, result=known) if isinstance(last.stopped, Ended) else last
    return Attempt(known)


def _retry(run: Run, case: Case | SequenceCase) -> Procedure[Attempt]:
    """Attempt a case again. Raises _Stopped when that was stopped."""
    again = yield from attempt(run, case)
    if again.stopped:
        raise _Stopped(again)
    return again


def _shortened(
    run: Run, case: SequenceCase, first: Attempt, mismatch: Mismatch
) -> Procedure[SequenceCase]:
    """A short sequence that fails as the first attempt did, on a device that was just switched on.

    One without a preamble is tried behind the settings of power-on: what settings of the cases
    before have left would else be missing from it.
    """
    if run.counters.minimised >= LONGEST_MINIMISED:
        return up_to(case, mismatch)
    run.counters.minimised += 1
    begun = case.setup or steps_to(run.protocol, run.protocol.power_on)
    behind = replace(case, setup=begun)
    short = yield from minimise(behind, first, mismatch, lambda shorter: _retry(run, shorter))
    return short if case.setup else replace(short, setup=())


def _is_no_noise(run: Run, first: Attempt, size: int, failed: int, tries: int) -> bool:
    """Whether so many of so many tries failed that noise on `size` bytes does not explain it."""
    # A spoilt byte shows in an answer: a missed stop beside right answers is none.
    if first.axis == "stop":
        return not run.config.observability.foreign or is_no_lie(run, first.looks, failed, tries)
    return is_no_chance(run, size, failed, tries)


def _burst_bytes(case: Case | SequenceCase, tried: Attempt) -> int:
    """Bytes on the line for the burst in which an attempt failed, answers included."""
    if isinstance(case, SequenceCase) and tried.mismatch and tried.mismatch.burst >= 0:
        return sum(len(step.frame) + 1 for step in case.bursts[tried.mismatch.burst].steps)
    return case_bytes(case)


def _cannot_be_noise(run: Run, tried: Attempt) -> bool:
    """Whether a stop was missed, for the second time in the run, although the answers were right.

    A byte changed on the line shows in an answer too; a stop that fails beside right answers is a
    fault of the device, even if it happens only now and then.
    """
    axes = tried.result.axes
    answer, stop = axes.get("answer"), axes.get("stop")
    if answer is None or stop is None:
        return False
    if answer.verdict >= Verdict.INCONCLUSIVE or stop.verdict is not Verdict.FAIL:
        return False
    run.counters.missed_stops += 1
    missed = run.counters.missed_stops
    if run.config.observability.foreign and not is_no_lie(run, 1, missed, run.looks.made):
        return False
    return missed > 1


def _placed(case: Case | SequenceCase, tried: Attempt) -> CaseResult:
    """The result with the clause that the failing step breaks, and the bytes sent up to it.

    What the preamble of a single frame did wrong is named with it. Only the final result says so:
    attempts are compared by the reasons that the look after the stimulus gives.
    """
    state = tried.result.axes.get("state")
    if tried.already and state and state.verdict is Verdict.FAIL:
        told = msgspec.structs.replace(state, reason=tried.already)
        return msgspec.structs.replace(tried.result, axes=tried.result.axes | {"state": told})
    if tried.mismatch is None or not isinstance(case, SequenceCase):
        return tried.result
    sent = tuple(spaced(data) for data in up_to(case, tried.mismatch).sent)
    step = tried.mismatch.step
    name, axis = tried.mismatch.name, tried.mismatch.axis
    place = f"burst {tried.mismatch.burst + 1}" if tried.mismatch.burst >= 0 else "set-up"
    what = f"{place}, frame {spaced(step.frame)}: {axis.reason}"
    told = Axis(axis.verdict, axis.expected, axis.actual, what, axis.reading)
    axes = tried.result.axes | {name: told}
    return msgspec.structs.replace(
        tried.result,
        axes=axes,
        clause=tried.mismatch.clause,
        planned_clause=case.clause,
        sent=sent,
    )


LONGEST_MINIMISED, _SHORTER = 5, 60  # sequences minimised in a run, tries for each


def up_to(case: SequenceCase, mismatch: Mismatch) -> SequenceCase:
    """The sequence up to and including the burst of the mismatch."""
    return replace(case, bursts=case.bursts[: max(0, mismatch.burst) + 1])


def minimise(
    case: SequenceCase,
    first: Attempt,
    mismatch: Mismatch,
    retry: Callable[[SequenceCase], Procedure[Attempt]],
) -> Procedure[SequenceCase]:
    """The shortest sequence found that still fails on the same axis, by the attempts of `retry`.

    Bursts are left out, first many at a time, then single frames of the rest. The preamble stays:
    the state it sets differs from the one after power-on. A sequence that failed in its preamble
    becomes the preamble's steps up to the failure.
    """
    last = mismatch.burst
    if last < 0:
        begun = case.setup[: len(case.setup) + last + 1]
        return replace(case, setup=(), bursts=tuple(Burst((step,)) for step in begun))
    best = replace(case, bursts=case.bursts[: last + 1])
    size, left = max(1, len(best.bursts) // 2), _SHORTER
    while left > 0:
        for shorter in (*_without_bursts(best, size), *(_without_steps(best) if size == 1 else ())):
            left -= 1
            tried = yield from retry(shorter)
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


def _without_bursts(sequence: SequenceCase, size: int) -> Iterator[SequenceCase]:
    """The sequence without each run of `size` consecutive bursts, the last ones first."""
    for end in range(len(sequence.bursts), 0, -size):
        left = sequence.bursts[: max(0, end - size)] + sequence.bursts[end:]
        if left:
            yield replace(sequence, bursts=left)


def _without_steps(sequence: SequenceCase) -> Iterator[SequenceCase]:
    """The sequence without each one frame of its longer bursts; their pauses may go with it."""
    for at, burst in enumerate(sequence.bursts):
        for index in range(len(burst.steps) if len(burst.steps) > 1 else 0):
            steps = burst.steps[:index] + burst.steps[index + 1 :]
            pauses = burst.pauses if index == len(burst.steps) - 1 else ()
            fewer = replace(burst, steps=steps, pauses=pauses)
            yield replace(
                sequence, bursts=(*sequence.bursts[:at], fewer, *sequence.bursts[at + 1 :])
            )


def reproducer(run: Run, case: SequenceCase) -> str:
    """The arguments of `bilprov send` that repeat the sequence: bytes, and pauses where needed."""
    bursts = (*(Burst((step,)) for step in case.setup), *case.bursts)
    words: list[str] = []
    split = any(burst.pauses for burst in bursts)
    gap = max(1, run.waiting.timeout // 16_000_000)
    for burst in bursts:
        data = burst.data
        places = [0, *(p for p in burst.pauses if p < len(data)), len(data)]
        for start, end in pairwise(places):
            words += [f"pause={gap}"] if start else []
            words.append(data[start:end].hex())
        if split and burst is not bursts[-1]:
            words.append(f"pause={run.waiting.usual // 1_000_000}")
    return " ".join((["--together"] if split else []) + words)


# -- whether what was observed may be due to spoilt bytes on the line -----------------------------
# `confirm` tries a failure again until its number is no chance, `agree` observes something unknown
# until its outcomes are enough alike; both by one likelihood, `is_no_chance`.

_UNLIKELY = 1e-4  # what is no chance
_FRAME = 3  # bytes on the line for a frame, its answer included, at least
_ENOUGH = 20  # failures: more make nothing surer
_SINGLE = 20  # bytes of a single-frame case's preamble and recovery


class Confirmed(NamedTuple):
    """What the tries after a failure showed: of so many it failed again in `failed`.

    It is `sure` where noise does not explain that.
    """

    sure: bool
    tries: int
    failed: int

    def judged(self, run: Run, result: CaseResult) -> CaseResult:
        """The result, its worst axes flaky if it is not sure (see `RunConfig.unsteady`)."""
        met, of = self.failed + 1, quantity(self.tries + 1, "try", "tries")
        return result.with_axes(
            {
                name: axis
                if self.sure or axis.verdict is not result.verdict
                else run.config.unsteady(axis, met, of)
                for name, axis in result.axes.items()
            }
        )


def confirm(
    run: Run,
    case: Case | SequenceCase,
    first: Attempt,
    again: Callable[[], Procedure[Attempt]],
    most: int = _MORE,
) -> Procedure[Confirmed]:
    """Make `again` what failed at `first`, until its failures are no noise, or too few for that.

    `most` is how many tries are made, where it does not fail in its place each time.
    """
    same_place = same_kind = tries = more = 0
    size = case_bytes(case)
    # On a line that was flaky before, the same failure in another place may be noise again.
    needed = _OFTEN + min(run.counters.flaky, _OFTEN)
    # On a line that is flaky throughout each case gets fewer tries.
    most = _TRIES if run.counters.flaky >= _FLAKY else max(FEW, min(most, _BYTES // size))
    # What fails in its place each time is told from noise by further tries.
    while tries < most or same_place == tries < _MORE:
        tried = yield from again()
        tries += 1
        if tried.failed:
            more += 1
            same_place += tried.where == first.where
            same_kind += tried.how == first.how
        # What stands still now and then fails now and then, in any place, and for long.
        seldom = first.held_up and 2 * more <= tries
        if (
            not seldom
            and same_place >= _TWICE
            and _is_no_noise(run, first, _burst_bytes(case, first), same_place, tries)
        ):
            return Confirmed(True, tries, more)
        # Noise hits a long sequence more often than a short one, and in any place.
        if not seldom and same_kind >= needed and _is_no_noise(run, first, size, same_kind, tries):
            return Confirmed(True, tries, more)
        if tries >= _TRIES and same_kind + (most - tries) < needed:
            break
    return Confirmed(False, tries, more)


class Outcome(Protocol):
    """What an observation showed."""

    @property
    def fault(self) -> object:
        """What it showed that no conforming device shows; "" or False for nothing."""

    @property
    def coarse(self) -> str:
        """Why the link was too slow to tell, "" if it was not."""

    def fits(self, other: Any) -> bool:
        """Whether both show the same."""


AnyOutcome = TypeVar("AnyOutcome", bound=Outcome)
AGREE, _SETTLED, _MOST = 2, 6, 12  # outcomes that agree; most tries, and where noise may differ


def agree(
    run: Run,
    case: Case,
    observe: Callable[[], Procedure[AnyOutcome]],
    needed: int = AGREE,
) -> Procedure[list[list[AnyOutcome]]]:
    """Observe until as many outcomes agree as are `needed`; three where they differ or one failed.

    Six times at most, twelve where noise may be why another outcome came more than once. Returns
    the outcomes, those together that agree, the most first.
    """
    kinds: list[list[AnyOutcome]] = []
    tries = 0
    while (tries < _SETTLED and (not kinds or len(kinds[0]) < needed)) or (
        tries < _MOST and may_be_noise(run, case, kinds)
    ):
        one = yield from observe()
        tries += 1
        alike = next((kind for kind in kinds if all(known.fits(one) for known in kind)), [])
        if not alike:
            kinds.append(alike)
        alike.append(one)
        kinds.sort(key=len, reverse=True)
        if one.fault or sum(not kind[0].coarse for kind in kinds) > 1:
            needed = AGREE + 1
    return kinds


def may_be_noise(run: Run, case: Case, kinds: Sequence[Sequence[Outcome]]) -> bool:
    """Whether spoilt bytes may be why a second kind of outcome came more than once."""
    # Where the link was too slow for a try, that is said instead.
    coarse = any(kind[0].coarse for kind in kinds)
    if coarse or run.config.lossless or len(kinds) < 2 or len(kinds[1]) < 2:
        return False
    return not is_no_chance(run, case_bytes(case), len(kinds[1]), sum(map(len, kinds)))


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
    spoilt = 1 - (1 - min(max(SPOILT, met), 1.0)) ** size
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
