"""Measures the truncation time-out: from a header whose data never come to answer and stop.

A robot may also stop because the line is silent (R-watchdog): where its stop comes without the
answer, the same silence after a complete instruction shows whether it is that of the time-out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import msgspec

from bilprov.analyzer.client.operations import Procedure, Received, listen, observe, send
from bilprov.captures.schemas import MS
from bilprov.conformance.cases.case import Case, in_motion
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.cases.single_frames import truncation_timeout
from bilprov.conformance.oracle.judge import judge_answers, look_words
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict
from bilprov.conformance.runner.homing import home, home_after, set_up_slowly, watch
from bilprov.conformance.runner.retry import AGREE, Confirmed, agree
from bilprov.conformance.runner.run import Run, Trial

# Between two looks: half of the time since the header, within these limits.
_FINEST, _COARSEST = MS, 10 * MS
_JITTER = 20 * MS  # of the link; times that differ by less count as equal
_PATIENCE = 500 * MS  # for a probe to show that it moves


@dataclass(frozen=True, slots=True)
class _Measured:
    """One measurement: the case's result, and the time-out (ns), None where none showed.

    `silent` is how long (ns) the line had been silent at a stop that came without the answer, 0
    where there was none.
    """

    result: CaseResult
    timeout: int | None
    silent: int = 0
    coarse: str = "the line delays what is measured"  # times that differ are no choices

    @property
    def fault(self) -> bool:
        """Whether the case failed."""
        return self.result.verdict is Verdict.FAIL

    def fits(self, other: _Measured) -> bool:
        """Whether both measurements agree, but for the jitter of the line."""
        if self.fault or other.fault:
            return self.fault and other.fault
        mine, theirs = self.timeout, other.timeout
        if bool(self.result.received) != bool(other.result.received):
            return False
        if mine is None or theirs is None:
            return mine is theirs
        return abs(mine - theirs) <= max(_JITTER, min(mine, theirs) // 2)


def measure_timeout(run: Run) -> Procedure[None]:
    """Measure the truncation time-out and judge it as a case. Leaves the line homed.

    A single result may be noise, a byte changed on the line.
    """
    case = truncation_timeout(run.protocol)
    if case is None:
        return
    run.begin(case.id)
    stop_tells, checked = True, False

    def measure() -> Procedure[_Measured]:
        nonlocal stop_tells, checked
        one = yield from _measure(run, case, stop_tells=stop_tells)
        if one.silent and not checked:
            checked, stop_tells = True, not (yield from _stops_by_itself(run, one.silent))
            if not stop_tells:
                return (yield from _measure(run, case, stop_tells=False))
        return one

    alike, *others = yield from agree(run, case, measure)
    made = [*alike, *chain(*others)]
    best = alike[0]
    times = [one.timeout for one in alike if one.timeout is not None]
    run.profile.truncation_timeout = min(times) if times else None
    every = [one.timeout for one in made if one.timeout is not None]
    spread = max(every, default=0) - min(every, default=0)
    if spread > _JITTER:  # pauses come out longer by that much too
        run.profile.jitter = max(spread, run.profile.jitter or 0)
    run.profile.truncation_answered = bool(best.result.received)
    failed = [one for one in made if one.fault] or alike
    sure = len(alike) > AGREE if best.fault else not others
    result = Confirmed(sure, len(made) - 1, len(failed) - 1).judged(run, failed[0].result)
    run.publish(msgspec.structs.replace(result, planned_clause=case.clause))


def _measure(run: Run, case: Case, *, stop_tells: bool) -> Procedure[_Measured]:
    """Measure once and home the line; late answers found while homing count against it.

    `stop_tells` if a stop shows that the time-out is over. One that is stopped after its answer is
    published, as no pass, and the run ends.
    """
    trial = Trial(run, case)
    timeout, silent = yield from _once(trial, case, stop_tells=stop_tells)
    homed = yield from home_after(run, trial)
    result = trial.end(homed)
    if homed.stopped:
        run.publish(result)
        raise homed.stopped
    return _Measured(result, timeout, silent)


def _drive(run: Run) -> Procedure[None]:
    """Set the robot moving."""
    assert run.profile.moves
    yield from set_up_slowly(run, in_motion(run.protocol, min(run.profile.moves)))


def _stops_by_itself(run: Run, silent: int) -> Procedure[bool]:
    """Whether the robot may stop in such a silence (ns) after a complete instruction too.

    Leaves the line homed.
    """
    yield from _drive(run)
    begun = yield from watch(run, moving=True)
    yield from listen(None, silent + _JITTER)
    seen = yield from observe()
    yield from home(run)
    return begun.look.moving is not False and seen.look.moving is not True


def _once(trial: Trial, case: Case, *, stop_tells: bool) -> Procedure[tuple[int | None, int]]:
    """Measure once: the time-out, and how silent the line was at a stop without the answer."""
    run = trial.run
    watched = run.config.observable and bool(run.profile.moves)
    if watched:
        yield from _drive(run)
        if run.config.observability.foreign:  # it may lag: what it shows now may be the rest before
            yield from watch(run, moving=True, patience=_PATIENCE)
    sent = yield from send(case.frame)
    heard, seen_still, moving = yield from _wait(run, sent, watched)
    stopped = seen_still if stop_tells else None
    moment = next((t for t, _ in heard.answers if t >= sent), stopped)
    # The answer is due when the time-out is over, which only a stop shows.
    axes = {
        "answer": judge_answers(
            run.protocol,
            case.accepted,
            heard,
            stopped or sent,
            timed=stopped is not None,
            timers=run.timers,
        )
    }
    if watched and heard.answers:
        seen = yield from watch(
            run, moving=False, patience=int(run.protocol.timing.stop_longest * MS)
        )
        if seen.look.moving:
            words, reason = look_words(seen.look), "answered, and still moves"
            axes["stop"] = Axis(Verdict.FAIL, "stopped", words, reason, "R-stop-latency")
    timeout = None
    if moment is not None:
        # The usual latency of an answer is not part of the time-out; a stop shows at once.
        usual = sorted(run.profile.latencies)[len(run.profile.latencies) // 2 :][:1]
        answered = moment - sent - sum(usual) if heard.answers else moment - sent
        seen_stopped = stopped - sent if stopped is not None else answered
        timeout = max(MS, min(answered, seen_stopped))
        axes["state"] = _in_limits(run, (stopped or moment) - sent)
    elif seen_still is not None:
        reason = "stops by itself while the line is silent, which hides the time-out"
        axes["stop"] = Axis(Verdict.INCONCLUSIVE, "stopped", "stopped", reason, "R-watchdog")
    elif moving:
        reason = "never timed out and kept driving"
        axes["stop"] = Axis(Verdict.FAIL, "stopped", "moving", reason, case.reading)
    else:
        axes["stop"] = run.config.not_observable("stopped")
    stop = axes.get("stop")
    if stop and stop.verdict is Verdict.FAIL and axes["answer"].verdict is not Verdict.FAIL:
        case = replace(case, clause=run.protocol.clauses.safety)
    trial.begin(case, axes, heard, sent)
    answer = heard.answers[0][0] if heard.answers else heard.now
    alone = stopped is not None and answer - stopped > _JITTER
    return timeout, stopped - sent if stopped is not None and alone else 0


def _wait(
    run: Run, sent: int, watched: bool
) -> Procedure[tuple[Received, int | None, bool | None]]:
    """Listen, observing the robot if `watched`, until an answer comes or `never` ns are over.

    Returns the answers, when (ns) the robot was seen stopped, None if it was not, and whether it
    moved in the last look.
    """
    heard = Received((), sent)
    stopped: int | None = None
    moving: bool | None = watched
    until = sent + run.timers.never
    while heard.now < until and not heard.answers:
        step = min(_COARSEST, max(_FINEST, (heard.now - sent) // 2))
        heard += yield from listen(1, step if watched else until - heard.now)
        if watched and stopped is None and not heard.answers:
            seen = yield from observe()
            moving = seen.look.moving
            if moving is False:
                stopped = seen.now
    heard += yield from listen(None, run.timers.silence)
    return heard, stopped, moving


def _in_limits(run: Run, timeout: int) -> Axis:
    timing = run.protocol.timing
    expected = f"{timing.truncation_shortest:g} ms to {timing.truncation_longest:g} ms"
    unsteady = run.profile.unsteadiness if run.line.coarse else 0
    if unsteady and not (
        timing.truncation_shortest <= (timeout - unsteady) / MS
        and (timeout + unsteady) / MS <= timing.truncation_longest
    ):
        words = f"{timeout / MS:.0f} ms, give or take {unsteady / MS:.0f} ms"
        return Axis(
            Verdict.INCONCLUSIVE, expected, words, run.line.sentence, "R-truncation-timeout"
        )
    inside = timing.truncation_shortest <= timeout / MS <= timing.truncation_longest
    verdict = Verdict.PASS if inside else Verdict.NON_STRICT
    reason = "" if inside else f"the time-out is {timeout / MS:.0f} ms"
    return Axis(verdict, expected, f"{timeout / MS:.1f} ms", reason, "R-truncation-timeout")


def needs_timeout(cases: Sequence[Case | SequenceCase]) -> bool:
    """Whether any of the cases depends on the truncation time-out."""
    return any(isinstance(c, SequenceCase) or c.truncated or c.short for c in cases)
