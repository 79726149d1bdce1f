"""Compares observations with the expected state of a sequence: after a burst, and while idle."""

from __future__ import annotations

from bilprov.analyzer.client.operations import Procedure, Received, listen, observe
from bilprov.captures.schemas import MS, Look
from bilprov.conformance.cases.steps import Step
from bilprov.conformance.oracle.judge import contradiction, differences, facets_of_motion
from bilprov.conformance.oracle.state_model import ExpectedState
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.oracle.wording import look_words, state_words
from bilprov.conformance.runner.sequence_answers import Mismatch, unasked
from bilprov.conformance.runner.trial import Trial
from bilprov.spec.readings import POINTS

_IDLE_MS = 4 * MS  # between two looks while the line is idle


def look_after(trial: Trial, step: Step, before: ExpectedState) -> Procedure[Mismatch | None]:
    """Observe until the state fits, for as long as a stop may take; return a mismatch, or None.

    `before` is the expected state before the step.
    """
    run = trial.run
    seen = yield from observe()
    start = seen.asked
    found = differences(run.model, trial.expected, seen.look)
    patience = max(run.timers.deadline, int(run.protocol.timing.stop_longest * MS))
    first = [facet for facet, _, _ in found]
    while found and seen.now - start < patience:
        heard = yield from listen(None, 2 * MS)
        if heard.answers:
            return unasked(trial, step, heard)
        seen = yield from observe()
        found = differences(run.model, trial.expected, seen.look)
    stops = trial.expected.still and any(f in facets_of_motion(run.protocol) for f in first)
    if not found:
        late = seen.asked - start
        if stops and late > run.timers.grace:
            reason = f"stopped only {late / MS:.0f} ms after its answer"
            words = "stopped", look_words(seen.look)
            axis = Axis(Verdict.NON_STRICT, *words, reason, "R-stop-latency")
            trial.axes["stop"] = axis
            run.profile.stop_latency = max(run.profile.stop_latency, late)
        _rest_on(trial, seen.look)
        return None
    run.waiting.in_vain(patience)
    facet, wanted, actual = found[0]
    reason = f"{facet} is {actual}, expected {wanted}"
    reading, why = contradiction(run.model, before, step.frame_effect, seen.look)
    words = state_words(trial.expected.state), look_words(seen.look)
    axis = Axis(Verdict.FAIL, *words, why or reason, reading)
    name = "stop" if stops and seen.look.moving else "state"
    clauses = run.protocol.clauses
    # An instruction that is to stop it and does not breaks what the table says of it.
    effect = step.frame_effect.effect
    told = effect is not None and effect.sets(run.protocol.car.by)
    safety = step.faulty or (name == "stop" and not told)
    clause = clauses.safety if safety else clauses.instructions
    return Mismatch(step, name, axis, clause)


def watch_idle(
    trial: Trial, step: Step, time: int, *, looks: bool = True
) -> Procedure[Mismatch | None]:
    """Send nothing for `time` ns and check that no answer comes, and that the state stays.

    The state is checked where the robot can be seen (`looks`).
    """
    run = trial.run
    until = (yield from listen(None, 0)).now + time
    now = 0
    while now < until:
        heard = yield from listen(None, min(_IDLE_MS, time))
        now = heard.now
        if heard.answers:
            return unasked(trial, step, heard)
        if not looks:
            continue
        seen = yield from observe()
        found = differences(run.model, trial.expected, seen.look)
        sleeps = run.profile.watchdog is not None or run.profile.choices.unknown("R-watchdog")
        asleep = sleeps and seen.look.moving is False
        if found and not asleep:
            return _by_itself(trial, step, trial.expected, found[0], seen.look)
    return None


def watch_time_out(
    trial: Trial, step: Step, before: ExpectedState, sent: int
) -> Procedure[tuple[Received, Mismatch | None]]:
    """Look at a robot that stood before a truncated frame, half-way through its time-out.

    What the frame before may do by itself shows there. Returns what was heard (at time 0 where it
    moved before, and is not looked at), and the mismatch where it moves. `before` is the expected
    state before the truncated frame, which had gone at `sent` (ns). Bytes may be on a slow line for
    as long as the slowest answer took: so long it may still move.
    """
    run, half = trial.run, trial.run.waiting.timeout // 2
    if not before.still or run.profile.stop_latency > half:
        return Received((), 0), None
    heard = yield from listen(None, half)
    trial.hear(heard)
    seen = yield from observe()
    arrived = 0 if run.config.virtual else sent + run.profile.slowest
    while seen.look.moving and seen.now < arrived:
        more = yield from listen(None, 2 * MS)
        trial.hear(more)
        heard = Received(heard.answers + more.answers, more.now)
        seen = yield from observe()
    if seen.look.moving:
        found = ("moving", False, True)
        return heard, _by_itself(trial, step, before, found, seen.look)
    return heard, None


def _by_itself(
    trial: Trial, step: Step, expected: ExpectedState, found: tuple[str, object, object], look: Look
) -> Mismatch:
    """The mismatch of a state that changed although nothing was sent."""
    facet, _, actual = found
    moves = expected.still and look.moving
    reason = "moved again by itself" if moves else f"{facet} became {actual} by itself"
    words = state_words(expected.state), look_words(look)
    axis = Axis(Verdict.FAIL, *words, reason)
    clauses = trial.run.protocol.clauses
    clause = clauses.safety if moves else clauses.instructions
    return Mismatch(step, "stop" if moves else "state", axis, clause)


def _rest_on(trial: Trial, look: Look) -> None:
    """Give the state axis the verdict of each other choice on which the matching state rests."""
    run = trial.run
    for point in sorted(trial.expected.rests_on):
        verdict, reading = run.profile.choices.verdict(point), POINTS[point].reading
        axis = trial.axes.get("state")
        if axis is None or verdict > axis.verdict:
            reason = f"{run.profile.choices.word(point)}: another reading of {reading}"
            words = state_words(trial.expected.state), look_words(look)
            trial.axes["state"] = Axis(verdict, *words, reason, reading)
