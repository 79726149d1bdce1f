"""Checks after a stop: it holds, settings do not restart the robot, a motion instruction does."""

from __future__ import annotations

from collections.abc import Callable

from bilprov.analyzer.client.operations import Procedure, Received, listen, observe, send
from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.steps import FrameClass, step_of
from bilprov.conformance.oracle.judge import differences, judge_state
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.oracle.wording import answer_words, look_words
from bilprov.conformance.runner.homing import watch
from bilprov.conformance.runner.trial import Trial
from bilprov.spec.by_effect import moving_to, setting
from bilprov.spec.codec import judge
from bilprov.spec.fields import Outcome

_MANY = (FrameClass.BAD_DATA, FrameClass.TRUNCATED)
"""The classes of faulty frames with the most cases."""


def stays_stopped(
    trial: Trial, case: Case, looks: bool, judged: Callable[[Received, int], Axis]
) -> Procedure[bool]:
    """Check that no more answers come and that the stop holds; `judged` judges all the answers.

    Returns whether the checks that follow (`restart_guard`) can be made.
    """
    run = trial.run
    # Of the many faulty frames, one in eight waits for silence: a late answer shows in the next
    # homing, and a stop that does not last shows in the sequences too.
    short = run.config.short_homing
    most = case.kind is not FrameClass.VALID if short else case.kind in _MANY
    many = most and not case.thorough
    brief = many and run.counters.next_check() % 8
    window = run.timers.settle if brief else max(run.timers.silence, run.timers.settle)
    costly = run.config.observability.costly
    long = case.thorough and not costly and (not short or run.counters.holds(case))
    rounds = max(1, run.timers.hold // window) if long else 1
    trial.settled = True
    for _ in range(rounds):
        more = yield from listen(None, window)
        if more.answers:
            trial.axes["answer"] = judged(*trial.hear(more))
        if looks and run.config.observable:
            seen = yield from observe()
            if seen.look.moving and trial.axes["stop"].verdict < Verdict.FAIL:
                words = look_words(seen.look)
                trial.worsen("stop", Verdict.FAIL, words, "moved again by itself")
                return False
    # Where a person or a command is the probe, no look is spent on it.
    return not costly


def restart_guard(trial: Trial, case: Case, looks: bool) -> Procedure[None]:
    """Check that settings with their present values do not restart the robot, and a motion does."""
    run = trial.run
    expected = trial.expected.state
    car = run.protocol.car
    settings = [
        frame
        for variable in (car.speed, *run.protocol.lights, car.steering)
        if run.wire(frame := setting(run.protocol, variable, getattr(expected, variable), expected))
    ]
    if settings and case.kind is not FrameClass.VALID:
        # After each fault one of them, in turn; after a Stop, which has few cases, all of them.
        settings = [settings[run.counters.next_check() % len(settings)]]
    for frame in settings:
        name = judge(run.protocol, frame).describe()
        yield from _step(trial, frame, name)
        if looks:
            seen = yield from observe()
            if seen.look.moving:
                reason = f"{name} restarted it, no motion instruction came"
                trial.worsen("stop", Verdict.FAIL, look_words(seen.look), reason)
    frame = moving_to(run.protocol, case.setup)
    if frame and case.setup.moving and case.kind is not FrameClass.VALID:
        yield from _step(trial, frame, judge(run.protocol, frame).name)
        if looks:
            yield from _moves_again(trial, frame)


def recovery(trial: Trial, case: Case, looks: bool) -> Procedure[None]:
    """Check that the valid instruction right after a fault is answered and takes effect."""
    run = trial.run
    yield from _step(trial, case.then, judge(run.protocol, case.then).name)
    if looks and run.config.observable:
        yield from _moves_again(trial, case.then)


def _step(trial: Trial, frame: bytes, name: str) -> Procedure[None]:
    """Send a valid instruction after the stimulus; it must get its one right answer.

    `frame` is as the grammar has it; the device is then expected to have carried it out. A device
    may discard what follows a fault until the line is idle (R-drain-known): one that has shown this
    gets its pause first, one that has not gets the instruction a second time.
    """
    run = trial.run
    effect = step_of(run.protocol, frame).frame_effect
    trial.expected = run.model.after(trial.expected, effect)
    pause, sent = run.waiting.idle, run.wire(frame)
    if run.profile.flushes:
        yield from listen(None, pause)
    yield from send(sent)
    heard = yield from run.waiting.answers(1)
    due = (run.protocol.answers[Outcome.VALID].code,)
    if heard.codes == due:
        return
    if not heard.answers:
        heard = yield from listen(None, max(pause, run.waiting.patience))
    if not heard.answers:
        yield from send(sent)
        again = yield from run.waiting.answers(1)
        if again.codes == due:
            run.waiting.answer_pending = False
            run.profile.flushes = True
            reason = f"{name} after the fault was lost, and taken when the line had been idle"
            words = answer_words(run.protocol, again.codes)
            trial.worsen("answer", Verdict.NON_STRICT, words, reason, "R-drain-known")
            return
    words = answer_words(run.protocol, heard.codes)
    trial.worsen("answer", Verdict.FAIL, words, f"{name} after the fault got {words}")


def _moves_again(trial: Trial, frame: bytes) -> Procedure[None]:
    """Check that the robot moves again in the expected state: no crash, nothing lost."""
    run = trial.run
    name, expected_state = judge(run.protocol, frame).name, trial.expected
    seen = yield from watch(
        run, moving=expected_state.state.moving, patience=run.timers.deadline, trial=trial
    )
    words = look_words(seen.look)
    if any(facet == "moving" for facet, _, _ in differences(run.model, expected_state, seen.look)):
        trial.worsen("state", Verdict.FAIL, words, f"{name} after the fault did not move it")
        return
    axis = judge_state(run.model, expected_state, seen.look)
    reason = f"{name} after the fault: {axis.reason}"
    trial.worsen("state", axis.verdict, words, reason, axis.reading)
