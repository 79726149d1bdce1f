"""After a stop: it holds, settings do not end it, a motion does, and nothing was lost by it."""

from __future__ import annotations

from collections.abc import Callable

from conformance.cases.preamble import moving_to, setting
from conformance.cases.single_frames import Case
from conformance.cases.steps import Class
from conformance.dut.operations import Heard, Script, listen, see, send
from conformance.oracle.judge import answer_words, differences, judge_belief, look_words
from conformance.oracle.state_model import Deed
from conformance.oracle.verdicts import Axis, Verdict
from conformance.runner.homing import watch
from conformance.runner.run import Run
from spec.codec import judge
from spec.fields import Outcome


def hold(run: Run, case: Case, looks: bool, judged: Callable[[Heard, int], Axis]) -> Script[bool]:
    """Until quiet: no more answers come (`judged` judges all of them), and the stop holds.

    Returns whether what comes after the stop can be tried.
    """
    # Where each value has a case of its own, or costs a time-out, one in four waits for silence: a
    # late answer shows in the next homing, and a stop that does not last in the walks too.
    many = case.kind in (Class.BAD_DATA, Class.TRUNCATED) and not case.thorough
    brief = many and run.next_nudge() % 4
    window = run.limits.settle if brief else run.limits.silence
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
    expected = run.belief.state
    settings = [
        frame
        for variable in ("speed", "led", "steering")
        if run.wire(frame := setting(run.protocol, variable, getattr(expected, variable)))
    ]
    if settings and case.kind is not Class.VALID:
        # One of them after each fault, in turn; after a Stop, which has few cases, all of them.
        settings = [settings[run.next_nudge() % len(settings)]]
    for frame in settings:
        name = judge(run.protocol, frame).describe()
        yield from _step(run, run.wire(frame), name)
        if looks:
            seen = yield from see()
            if seen.look.moving:
                reason = f"{name} restarted it, no motion instruction came"
                run.worsen("stop", Verdict.FAIL, look_words(seen.look), reason)
    mover = moving_to(run.protocol, case.setup.motion)
    if mover is not None and case.setup.moving and case.kind is not Class.VALID:
        frame = bytes([run.protocol.header_bytes[mover.id, 0]])
        yield from _step(run, frame, mover.name)
        run.belief = run.model.after(run.belief, Deed(mover.effect))
        if looks:
            yield from _moves_again(run, frame)


def recover(run: Run, case: Case, looks: bool) -> Script[None]:
    """The valid instruction right after a fault works."""
    judged = judge(run.protocol, case.then)
    yield from _step(run, case.then, judged.name)
    assert judged.instruction is not None
    run.belief = run.model.after(run.belief, Deed(judged.instruction.effect))
    if looks and run.looks_freely:
        yield from _moves_again(run, case.then)


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


def _moves_again(run: Run, frame: bytes) -> Script[None]:
    """It moves again with what was kept: the stop was no crash, the fault changed nothing."""
    name, belief = judge(run.protocol, frame).name, run.belief
    seen = yield from watch(run, moving=belief.state.moving, patience=run.limits.deadline)
    words = look_words(seen.look)
    if any(facet == "moving" for facet, _, _ in differences(run.model, belief, seen.look)):
        run.worsen("state", Verdict.FAIL, words, f"{name} after the fault did not move it")
        return
    axis = judge_belief(run.model, belief, seen.look)
    reason = f"{name} after the fault: {axis.reason}"
    run.worsen("state", axis.verdict, words, reason, axis.reading)
