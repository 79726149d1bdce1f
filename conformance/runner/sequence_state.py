"""Holds what is seen of a robot that walks against the model: after a burst, and left alone."""

from __future__ import annotations

from captures.schemas import Look
from conformance.cases.sequence import Mismatch
from conformance.cases.steps import Step
from conformance.dut.operations import Script, listen, see
from conformance.oracle.choices import POINTS
from conformance.oracle.judge import MOVING, MS, contradiction, differences, look_words, state_words
from conformance.oracle.state_model import Belief
from conformance.oracle.verdicts import Axis, Verdict
from conformance.runner.run import Run
from conformance.runner.sequence_answers import unasked

_DWELL = 4 * MS  # between two looks at a robot that is left alone


def look_after(run: Run, step: Step, before: Belief) -> Script[Mismatch | None]:
    """Look until it fits, for as long as a stop may take; `before` was believed before the step."""
    seen = yield from see()
    start = seen.asked
    found = differences(run.model, run.belief, seen.look)
    patience = max(run.limits.deadline, int(run.protocol.timing.stop_longest * MS))
    first = [facet for facet, _, _ in found]
    while found and seen.now - start < patience:
        heard = yield from listen(None, 2 * MS)
        if heard.answers:
            return unasked(run, step, heard)
        seen = yield from see()
        found = differences(run.model, run.belief, seen.look)
    stops = run.belief.still and any(facet in MOVING for facet in first)
    if not found:
        late = seen.asked - start
        if stops and late > run.limits.grace:
            reason = f"stopped only {late / MS:.0f} ms after its answer"
            words = "stopped", look_words(seen.look)
            axis = Axis(Verdict.NON_STRICT, *words, reason, "R-stop-latency")
            run.axes["stop"] = axis
            run.profile.stop_latency = max(run.profile.stop_latency, late)
        _rest_on(run, seen.look)
        return None
    run.waste(patience)
    facet, wanted, actual = found[0]
    reason = f"{facet} is {actual}, expected is {wanted}"
    reading, why = contradiction(run.model, before, step.deed, seen.look)
    words = state_words(run.belief.state), look_words(seen.look)
    axis = Axis(Verdict.FAIL, *words, why or reason, reading)
    name = "stop" if stops and seen.look.moving else "state"
    clauses = run.protocol.clauses
    safety = name == "stop" or step.faulty
    clause = clauses.safety if safety else clauses.instructions
    return Mismatch(step, name, axis, clause)


def dwell(run: Run, step: Step, time: int) -> Script[Mismatch | None]:
    """Nothing is sent for `time` ns: nothing comes, and nothing changes by itself."""
    until = (yield from listen(None, 0)).now + time
    now = 0
    while now < until:
        heard = yield from listen(None, min(_DWELL, time))
        now = heard.now
        if heard.answers:
            return unasked(run, step, heard)
        seen = yield from see()
        found = differences(run.model, run.belief, seen.look)
        asleep = run.profile.watchdog is not None and seen.look.moving is False
        if found and not asleep:
            facet, _, actual = found[0]
            moves = run.belief.still and seen.look.moving
            reason = "moved again by itself" if moves else f"{facet} became {actual} by itself"
            words = state_words(run.belief.state), look_words(seen.look)
            axis = Axis(Verdict.FAIL, *words, reason)
            clauses = run.protocol.clauses
            clause = clauses.safety if moves else clauses.instructions
            return Mismatch(step, "stop" if moves else "state", axis, clause)
    return None


def _rest_on(run: Run, look: Look) -> None:
    """Another choice that shaped what was rightly seen gives the walk its verdict."""
    for point in run.belief.rests:
        verdict, reading = run.profile.choices.verdict(point), POINTS[point].reading
        axis = run.axes.get("state")
        if axis is None or verdict > axis.verdict:
            reason = f"{run.profile.choices.word(point)}: another reading of {reading}"
            words = state_words(run.belief.state), look_words(look)
            run.axes["state"] = Axis(verdict, *words, reason, reading)
