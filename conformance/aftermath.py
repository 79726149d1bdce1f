"""After a stop: it holds, settings do not end it, a motion does, and nothing was lost by it."""

from __future__ import annotations

from collections.abc import Callable

from conformance.asks import Heard, Script, listen, see, send
from conformance.cases import Case, Class
from conformance.homing import watch
from conformance.judging import answer_words, judge_state, look_words
from conformance.run import Run
from conformance.setup import moving_to, setting
from conformance.verdicts import Axis, Verdict
from spec.codec import judge
from spec.fields import Outcome
from spec.motion import State


def hold(run: Run, case: Case, looks: bool, judged: Callable[[Heard, int], Axis]) -> Script[bool]:
    """Until quiet: no more answers come (`judged` judges all of them), and the stop holds.

    Returns whether what comes after the stop can be tried.
    """
    window = run.limits.silence
    rounds = max(1, run.limits.hold // window) if case.thorough and not run.eyes.sparse else 1
    for _ in range(rounds):
        more = yield from listen(None, window)
        if more.answers:
            run.axes["answer"] = judged(*run.hear(more))
        if looks and run.looks_freely:
            seen = yield from see()
            if seen.look.moving and run.axes["stop"].verdict < Verdict.FAIL:
                words = look_words(seen.look)
                run.worsen("stop", Verdict.FAIL, words, "moved again by itself")
                return False
    # A person or a process that looks has no looks left for it.
    return not run.eyes.sparse


def restart(run: Run, case: Case, looks: bool) -> Script[None]:
    """Settings that change nothing must not restart the robot; a motion instruction must."""
    expected = case.expected
    settings = [
        frame
        for variable in ("speed", "led", "steering")
        if (frame := setting(run.protocol, variable, getattr(expected, variable)))
    ]
    if settings and case.kind is not Class.VALID:
        # One of them after each fault, in turn; after a Stop, which has few cases, all of them.
        settings = [settings[run.next_nudge() % len(settings)]]
    for frame in settings:
        name = judge(run.protocol, frame).describe()
        yield from _step(run, frame, name)
        if looks:
            seen = yield from see()
            if seen.look.moving:
                reason = f"{name} restarted it, no motion instruction came"
                run.worsen("stop", Verdict.FAIL, look_words(seen.look), reason)
    mover = moving_to(run.protocol, case.setup.motion)
    if mover is not None and case.setup.moving and case.kind is not Class.VALID:
        frame = bytes([run.protocol.header_bytes[mover.id, 0]])
        yield from _step(run, frame, mover.name)
        if looks:
            yield from _moves_again(run, case, mover.effect.apply(expected), frame)


def recover(run: Run, case: Case, looks: bool) -> Script[None]:
    """The valid instruction right after a fault works."""
    assert case.after_then is not None
    yield from _step(run, case.then, judge(run.protocol, case.then).name)
    if looks and run.looks_freely:
        yield from _moves_again(run, case, case.after_then, case.then)


def _step(run: Run, frame: bytes, name: str) -> Script[None]:
    """A valid instruction after the stimulus, which must be answered once and well.

    A device may throw away what follows a fault until the line is idle (R-drain-known): one that
    has shown it gets its pause, one that has not is asked a second time.
    """
    pause = run.timeout + run.limits.settle
    if run.profile.flushes:
        yield from listen(None, pause)
    yield from send(frame)
    heard = yield from run.answers(1)
    due = (run.protocol.answers[Outcome.VALID].code,)
    if heard.codes == due:
        return
    if not heard.answers:
        heard = yield from listen(None, max(pause, run.patience))
    if not heard.answers:
        yield from send(frame)
        again = yield from run.answers(1)
        if again.codes == due:
            run.missing = False
            run.profile.flushes = True
            reason = f"{name} after the fault was lost, and taken when the line had been idle"
            words = answer_words(run.protocol, again.codes)
            run.worsen("answer", Verdict.NON_STRICT, words, reason, "R-drain-known")
            return
    words = answer_words(run.protocol, heard.codes)
    run.worsen("answer", Verdict.FAIL, words, f"{name} after the fault got {words}")


def _moves_again(run: Run, case: Case, expected: State, frame: bytes) -> Script[None]:
    """It moves again with what was kept: the stop was no crash, the fault changed nothing."""
    name = judge(run.protocol, frame).name
    seen = yield from watch(run, moving=expected.moving, patience=run.limits.deadline)
    words = look_words(seen.look)
    if seen.look.moving is not (not expected.moving):
        axis = judge_state(expected, case.setup, seen.look, "fault")
        reason = f"{name} after the fault: {axis.reason}"
        run.worsen("state", axis.verdict, words, reason, axis.reading)
        return
    # A speed that the fault has zeroed is a legal other choice (R-fault-state): then it rightly
    # stands still, and moves once it has been told a speed.
    speed = setting(run.protocol, "speed", expected.speed)
    if speed and not seen.look.speed:
        yield from send(speed)
        yield from run.answers(1)
        yield from send(frame)
        yield from run.answers(1)
        seen = yield from watch(run, moving=True, patience=run.limits.deadline)
        if seen.look.moving:
            reason = f"{name} after the fault moved it only with a new speed"
            run.worsen("state", Verdict.INFORMATIONAL, words, reason, "R-fault-state")
            return
    run.worsen("state", Verdict.FAIL, words, f"{name} after the fault did not move it")
