"""Measures how long a frame may pause: from a header whose data never come to answer and stop."""

from __future__ import annotations

from conformance.asks import Heard, Script, listen, see, send
from conformance.cases import Case
from conformance.homing import set_up
from conformance.judging import MS, judge_answers
from conformance.opening import truncation_timeout
from conformance.run import Run
from conformance.verdicts import Axis, Verdict
from spec.motion import State

_STEP = 10 * MS


def measure_timeout(run: Run) -> Script[None]:
    """Measure the truncation time-out once, with one long wait, and judge it as a case."""
    case = truncation_timeout(run.protocol)
    if case is None:
        return
    run.begin(case.id)
    watched = run.looks_freely and bool(run.moves)
    if watched and run.moves:
        _, fast = run.protocol.limits.get("speed", (0, 0))
        yield from set_up(run, State(motion=min(run.moves), speed=fast))
    sent = yield from send(case.stimulus)
    heard, stopped = yield from _wait(run, sent, watched)
    run.profile.truncation_answered = bool(heard.answers)
    moment = next((t for t, _ in heard.answers if t >= sent), stopped)
    # The answer is due when the time-out is over, which only a stop shows.
    axes = {
        "answer": judge_answers(
            run.protocol, case.accepted, heard, stopped or sent, timed=stopped is not None
        )
    }
    if moment is not None:
        run.profile.truncation_timeout = moment - sent
        axes["state"] = _in_limits(run, (stopped or moment) - sent)
    elif watched:
        reason = "never timed out and kept driving"
        axes["stop"] = Axis(Verdict.FAIL, "stopped", "moving", reason, case.reading)
    else:
        axes["stop"] = run.blind("stopped")
    run.open(case, axes, heard, sent)


def _wait(run: Run, sent: int, watched: bool) -> Script[tuple[Heard, int | None]]:
    """Listen, and look where looking is cheap, until it answers and stops, or for ever long."""
    heard = Heard((), sent)
    stopped: int | None = None
    until = sent + run.limits.never
    while heard.now < until and not heard.answers:
        more = yield from listen(1, _STEP if watched else until - heard.now)
        heard = Heard(heard.answers + more.answers, more.now)
        if watched and stopped is None and not heard.answers:
            seen = yield from see()
            if seen.look.moving is False:
                stopped = seen.now
    more = yield from listen(None, run.limits.silence)
    return Heard(heard.answers + more.answers, more.now), stopped


def _in_limits(run: Run, timeout: int) -> Axis:
    timing = run.protocol.timing
    expected = f"{timing.truncation_shortest:g} ms to {timing.truncation_longest:g} ms"
    inside = timing.truncation_shortest <= timeout / MS <= timing.truncation_longest
    verdict = Verdict.PASS if inside else Verdict.NON_STRICT
    reason = "" if inside else f"the time-out is {timeout / MS:.0f} ms"
    return Axis(verdict, expected, f"{timeout / MS:.1f} ms", reason, "R-truncation-timeout")


def needs_timeout(cases: tuple[Case, ...]) -> bool:
    """Whether any of the cases waits for the time-out."""
    return any(case.arrived is not None or case.short for case in cases)
