"""Tries one case: set-up, stimulus, all answers, the stop, the state, and what comes after."""

from __future__ import annotations

from conformance.cases.adaptation import as_chosen
from conformance.cases.single_frames import Case
from conformance.cases.steps import Class
from conformance.dut.operations import Heard, Script, Seen, listen, see, send
from conformance.oracle.judge import (
    MOVING,
    MS,
    NOT_OBSERVABLE,
    answer_words,
    contradiction,
    judge_answers,
    judge_belief,
    look_words,
    state_words,
    unseen,
)
from conformance.oracle.verdicts import Axis, Verdict
from conformance.runner.after_stop import hold, recover, restart
from conformance.runner.homing import set_up, watch
from conformance.runner.run import Run
from spec.fields import Outcome


def try_case(run: Run, case: Case) -> Script[None]:
    """Try a case on a homed line. It is left open: the next homing makes it final."""
    case = case.as_step(as_chosen(run.protocol, run.profile.choices, case.step))
    looks = run.looks_at(case)
    lost, stray = yield from _precondition(run, case, looks)
    if stray.answers:
        words = answer_words(run.protocol, stray.codes)
        reason = "answers came without an instruction"
        axis = Axis(Verdict.FAIL, "no answer", words, reason, "R-unsolicited")
        run.open(case, {"answer": axis}, stray, stray.now)
        return
    if lost and case.kind is not Class.VALID:
        axis = Axis(Verdict.INCONCLUSIVE, "", "", f"precondition lost: {lost}")
        run.open(case, {"answer": axis}, Heard((), 0), 0)
        return
    sent = yield from send(case.stimulus)
    run.before, run.belief = run.belief, run.model.after(run.belief, case.deed)
    heard, filled = yield from _answers(run, case, sent)

    def judged(heard: Heard, sent: int) -> Axis:
        return _judge_heard(run, case, heard, sent, filled)

    run.open(case, {"answer": judged(heard, sent)}, heard, sent)
    if case.arrived is None:
        run.profile.measured(heard, sent)
    # A truncated frame was left alone for its time-out, however early its answer came.
    whole = heard.answers and case.arrived is None
    answered = heard.answers[-1][0] if whole else heard.now
    if not looks:
        if case.stop:
            run.axes["stop"] = run.blind("stopped")
        run.axes["state"] = run.blind(state_words(run.belief.state))
    elif case.stop:
        yield from _stop(run, case, answered)
    else:
        yield from _state(run, case)
    if case.then:
        yield from recover(run, case, looks)
    elif case.stop and (yield from hold(run, case, looks, judged)):
        yield from restart(run, case, looks)


def _precondition(run: Run, case: Case, looks: bool) -> Script[tuple[str, Heard]]:
    """Bring the robot to where the case begins.

    Returns what is missing, "" if nothing, and the answers that came without an instruction.
    """
    lost = yield from set_up(run, case.setup)
    if not lost and looks and case.setup.moving:
        moves = run.moves is None or case.setup.motion in run.moves
        patience = run.limits.deadline if moves else 0
        seen = yield from watch(run, moving=True, patience=patience)
        if not seen.look.moving:
            lost = f"not seen moving ({case.setup.motion.value}) before the stimulus"
    stray = yield from listen(None, 0)
    return lost, stray


def _answers(run: Run, case: Case, sent: int) -> Script[tuple[Heard, bool]]:
    """All that is due, and whether a filler was sent in order to get it."""
    due = len(case.accepted[0].codes)
    if case.arrived is not None:
        return (yield from _after_silence(run, due, sent)), False
    if not case.short:
        return (yield from run.answers(due)), False
    # Half a time-out without an answer: is it slow, or does it wait for data nobody announced?
    heard = yield from listen(due, run.timeout // 2)
    if len(heard.answers) >= due:
        return heard, False
    yield from send(bytes([run.protocol.filler]))
    more = yield from run.answers(due + 1)
    return Heard(heard.answers + more.answers, more.now), True


def _after_silence(run: Run, due: int, sent: int) -> Script[Heard]:
    """What comes while a truncated frame is left alone, for its whole time-out."""
    timeout = run.timeout
    pause = timeout + timeout // 4 + run.limits.settle
    if run.profile.truncation_answered is False:
        return (yield from listen(None, pause))
    heard = yield from run.answers(due, pause + run.usual)
    run.timeouts += run.timeout if heard.answers else 0
    if heard.now - sent < timeout // 2:
        # Answered at its header: what comes now would still be taken for its data.
        more = yield from listen(None, sent + pause - heard.now)
        heard = Heard(heard.answers + more.answers, more.now)
    return heard


def _judge_heard(run: Run, case: Case, heard: Heard, sent: int, filled: bool) -> Axis:
    """The answer axis of what was heard so far; `filled` if a filler was sent after the frame."""
    if filled:
        ok = run.protocol.answers[Outcome.VALID].code
        own = list(heard.answers)
        last = next((entry for entry in reversed(own) if entry[1] == ok), None)
        if last is None and own:
            actual = answer_words(run.protocol, heard.codes)
            reason = "took the next byte for data that the header does not announce"
            expected = answer_words(run.protocol, case.accepted[0].codes)
            return Axis(Verdict.FAIL, expected, actual, reason, "R-example-right")
        if last is not None:
            own.remove(last)
        heard = Heard(tuple(own), heard.now)
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
        run.profile.stop_latency = max(run.profile.stop_latency, late)
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
    axis = judge_belief(run.model, run.belief, seen.look, elsewhere)
    if axis.verdict is Verdict.FAIL:
        reading, why = contradiction(run.model, run.before, case.deed, seen.look)
        if why:
            axis = Axis(axis.verdict, axis.expected, axis.actual, why, reading)
    if axis.verdict is Verdict.FAIL and run.moves == set():
        reason = "never seen moving in any kind of motion: is the motor power on?"
        return Axis(Verdict.INCONCLUSIVE, axis.expected, axis.actual, reason)
    blind = unseen(case, seen.look)
    if blind and axis.verdict < Verdict.INCONCLUSIVE:
        reason = f"{NOT_OBSERVABLE}: {blind}"
        return Axis(Verdict.INCONCLUSIVE, axis.expected, axis.actual, reason)
    return axis
