"""Tries one case: set-up, stimulus, all answers until quiet, the stop, the state, and after it."""

from __future__ import annotations

from conformance.asks import Heard, Script, Seen, listen, see, send
from conformance.cases import Case, Class
from conformance.homing import set_up, watch
from conformance.judging import (
    MOVING,
    MS,
    NOT_OBSERVABLE,
    answer_words,
    judge_answers,
    judge_state,
    look_words,
    state_words,
    unseen,
)
from conformance.run import Run
from conformance.setup import moving_to, setting
from conformance.verdicts import Axis, Verdict
from spec.codec import judge
from spec.fields import Outcome
from spec.motion import State


def try_case(run: Run, case: Case) -> Script[None]:
    """Try a case on a homed line. It is left open: the next homing makes it final."""
    looks = run.looks_at(case)
    lost = yield from _precondition(run, case, looks)
    if lost and case.kind is not Class.VALID:
        axis = Axis(Verdict.INCONCLUSIVE, "", "", f"precondition lost: {lost}")
        run.open(case, {"answer": axis}, Heard((), 0), 0)
        return
    sent = yield from send(case.stimulus)
    heard = yield from _answers(run, case)
    run.open(case, {"answer": _judge(run, case, heard, sent)}, heard, sent)
    if case.arrived is None:
        run.profile.measured(heard, sent)
    answered = heard.answers[-1][0] if heard.answers else heard.now
    if not looks:
        if case.stop:
            run.axes["stop"] = run.blind("stopped")
        run.axes["state"] = run.blind(state_words(case.expected))
    elif case.stop:
        yield from _stop(run, case, answered)
    else:
        yield from _state(run, case)
    if case.then:
        yield from _then(run, case, looks)
    elif case.stop:
        yield from _hold(run, case, looks)


def _precondition(run: Run, case: Case, looks: bool) -> Script[str]:
    """Bring the robot to where the case begins; returns what is missing, "" if nothing."""
    lost = yield from set_up(run, case.setup)
    if not lost and looks and case.setup.moving:
        moves = run.moves is None or case.setup.motion in run.moves
        patience = run.limits.deadline if moves else 0
        seen = yield from watch(run, moving=True, patience=patience)
        if not seen.look.moving:
            lost = f"not seen moving ({case.setup.motion.value}) before the stimulus"
    stray = yield from listen(None, 0)
    return "answers came without an instruction" if stray.answers else lost


def _answers(run: Run, case: Case) -> Script[Heard]:
    """All that is due. A truncated frame is first left alone for its time-out."""
    due = len(case.accepted[0].codes)
    timeout = run.profile.truncation_timeout
    usual = int(run.protocol.timing.truncation_timeout * MS)
    if case.arrived is not None:
        wait = int((2 * usual if timeout is None else timeout) * 1.25) + run.limits.settle
        if run.profile.truncation_answered is False:
            return (yield from listen(None, wait))
        return (yield from run.answers(due, wait + run.limits.deadline))
    if not case.short:
        return (yield from run.answers(due))
    # Half a time-out without an answer: is it slow, or does it wait for data nobody announced?
    heard = yield from listen(due, (usual if timeout is None else timeout) // 2)
    if len(heard.answers) >= due:
        return heard
    yield from send(bytes([run.protocol.filler]))
    more = yield from run.answers(due + 1)
    return Heard(heard.answers + more.answers, more.now)


def _judge(run: Run, case: Case, heard: Heard, sent: int) -> Axis:
    """The answer axis of what was heard so far."""
    due = len(case.accepted[0].codes)
    timeout = run.profile.truncation_timeout or int(run.protocol.timing.truncation_timeout * MS)
    asked_twice = case.short and heard.answers and heard.answers[0][0] - sent >= timeout // 2
    if asked_twice and len(heard.answers) == due:
        actual = answer_words(run.protocol, heard.codes)
        reason = "took the next byte for data that the header does not announce"
        expected = answer_words(run.protocol, case.accepted[0].codes)
        return Axis(Verdict.FAIL, expected, actual, reason, "R-example-right")
    if asked_twice:
        heard = Heard(heard.answers[:due] + heard.answers[due + 1 :], heard.now)
    timed = case.arrived is None
    return judge_answers(run.protocol, case.accepted, heard, sent, timed=timed)


def _stop(run: Run, case: Case, answered: int) -> Script[None]:
    """The stop axis: standing still when the answer is there; and the state it left."""
    longest = int(run.protocol.timing.stop_longest * MS)
    seen = yield from watch(run, moving=False, patience=longest)
    words, reading = look_words(seen.look), "R-stop-latency"
    late = seen.asked - answered
    if seen.look.moving is None:
        axis = Axis(Verdict.INCONCLUSIVE, "stopped", words, NOT_OBSERVABLE)
    elif seen.look.moving:
        reason = f"still moves {late / MS:.0f} ms after its answer was due"
        axis = Axis(Verdict.FAIL, "stopped", words, reason, reading)
    elif late > run.limits.grace:
        reason = f"stopped only {late / MS:.0f} ms after its answer"
        axis = Axis(Verdict.NON_STRICT, "stopped", words, reason, reading)
    else:
        axis = Axis(Verdict.PASS, "stopped", words)
    run.axes["stop"] = axis
    run.axes["state"] = _judge_state(run, case, seen)


def _state(run: Run, case: Case) -> Script[None]:
    """The state axis of an instruction that need not stop: looked at until it fits."""
    seen = yield from see()
    start = seen.asked
    axis = _judge_state(run, case, seen)
    patience = run.limits.deadline
    while axis.verdict is Verdict.FAIL and seen.now - start < patience:
        heard = yield from listen(None, 10 * MS)
        run.hear(heard)
        seen = yield from see()
        axis = _judge_state(run, case, seen)
    if axis.verdict is Verdict.FAIL:
        run.waste(patience)
    run.axes["state"] = axis


def _judge_state(run: Run, case: Case, seen: Seen) -> Axis:
    elsewhere = MOVING if case.stop and seen.look.moving else ()
    axis = judge_state(case.expected, case.setup, seen.look, case.occasion, elsewhere)
    if axis.verdict is Verdict.FAIL and run.moves == set():
        reason = "never seen moving in any kind of motion: is the motor power on?"
        return Axis(Verdict.INCONCLUSIVE, axis.expected, axis.actual, reason)
    blind = unseen(case, seen.look)
    if blind and axis.verdict < Verdict.INCONCLUSIVE:
        reason = f"{NOT_OBSERVABLE}: {blind}"
        return Axis(Verdict.INCONCLUSIVE, axis.expected, axis.actual, reason)
    return axis


def _hold(run: Run, case: Case, looks: bool) -> Script[None]:
    """Until quiet: no more answers, and the stop holds."""
    window = run.limits.silence
    rounds = max(1, run.limits.hold // window) if case.thorough and not run.eyes.sparse else 1
    for _ in range(rounds):
        more = yield from listen(None, window)
        if more.answers:
            heard, sent = run.hear(more)
            run.axes["answer"] = _judge(run, case, heard, sent)
        if looks and run.looks_freely:
            seen = yield from see()
            if seen.look.moving and run.axes["stop"].verdict < Verdict.FAIL:
                words = look_words(seen.look)
                run.worsen("stop", Verdict.FAIL, words, "moved again by itself")
                return
    if run.looks_freely or not run.eyes.open:
        yield from _restart(run, case, looks)


def _restart(run: Run, case: Case, looks: bool) -> Script[None]:
    """Settings that change nothing must not restart the robot; a motion instruction must."""
    expected = case.expected
    settings = [
        frame
        for variable in ("speed", "led", "steering")
        if (frame := setting(run.protocol, variable, getattr(expected, variable)))
    ]
    if settings:
        frame = settings[run.next_nudge() % len(settings)]
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
            yield from _moves_again(run, case, mover.effect.apply(expected), mover.name)


def _then(run: Run, case: Case, looks: bool) -> Script[None]:
    """The valid instruction right after a fault works."""
    assert case.after_then is not None
    name = judge(run.protocol, case.then).name
    yield from _step(run, case.then, name)
    if looks and run.looks_freely:
        yield from _moves_again(run, case, case.after_then, name)


def _step(run: Run, frame: bytes, name: str) -> Script[None]:
    """A valid instruction after the stimulus, which must be answered once and well."""
    yield from send(frame)
    heard = yield from run.answers(1)
    due = (run.protocol.answers[Outcome.VALID].code,)
    if heard.codes != due:
        words = answer_words(run.protocol, heard.codes)
        reason = f"{name} after the fault got {words}"
        run.worsen("answer", Verdict.FAIL, words, reason)


def _moves_again(run: Run, case: Case, expected: State, name: str) -> Script[None]:
    """It moves again with what was kept: the stop was no crash, the fault changed nothing."""
    seen = yield from watch(run, moving=expected.moving, patience=run.limits.deadline)
    words = look_words(seen.look)
    if seen.look.moving is (not expected.moving):
        # A speed that the fault has zeroed is a legal other choice: then it rightly stands still.
        zeroed = run.axes["state"].reading == "R-fault-state" and seen.look.speed == 0
        verdict = Verdict.INFORMATIONAL if zeroed else Verdict.FAIL
        run.worsen("state", verdict, words, f"{name} after the fault did not move it")
        return
    axis = judge_state(expected, case.setup, seen.look, "fault")
    run.worsen("state", axis.verdict, words, f"{name} after the fault: {axis.reason}")
