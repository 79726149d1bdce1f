"""Executes one single-frame test case: preamble, stimulus, answers, stop, state, later checks.

After a stop it is checked that it holds, that settings do not restart the robot, and that a motion
instruction does.
"""

from __future__ import annotations

from collections.abc import Callable, Container

from bilprov.analyzer.client.operations import (
    Observation,
    Procedure,
    Received,
    listen,
    observe,
    send,
)
from bilprov.captures.schemas import MS, Look
from bilprov.conformance.cases.adaptation import adapt_to_device
from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.steps import FrameClass, step_of
from bilprov.conformance.oracle.judge import (
    answer_words,
    contradiction,
    deviation,
    differences,
    facets_of_motion,
    judge_answers,
    judge_state,
    look_words,
    state_words,
)
from bilprov.conformance.oracle.sight import NOT_OBSERVABLE, facets_of, untold
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.runner.homing import SetUp, home, preamble_of, set_up, watch
from bilprov.conformance.runner.run import Run, Trial
from bilprov.spec.by_effect import moving_to, setting
from bilprov.spec.codec import judge, spaced
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol


def run_single_frame(trial: Trial, case: Case) -> Procedure[None]:
    """Execute a case on a homed line: preamble, stimulus, and the checks after it."""
    run = trial.run
    case = case.adapted(adapt_to_device(run.protocol, run.profile.choices, case))
    sees = run.config.observability
    looks = sees.available and (case.thorough or not sees.costly)
    ready, stray = yield from _precondition(run, case, looks)
    if stray.answers:
        words = answer_words(run.protocol, stray.codes)
        reason = "answers came without an instruction"
        axis = Axis(Verdict.FAIL, "no answer", words, reason, "R-unsolicited")
        trial.begin(case, {"answer": axis}, stray, stray.now)
        return
    if ready.missing and case.kind is not FrameClass.VALID:
        axis = Axis(Verdict.INCONCLUSIVE, "", "", f"precondition lost: {ready.missing}")
        trial.begin(case, {"answer": axis}, Received((), 0), 0)
        return
    sent = yield from send(case.frame)
    trial.before, trial.look_before, trial.preamble = ready.expected, ready.look, ready.frames
    trial.expected = run.model.after(ready.expected, case.frame_effect)
    heard, filled = yield from _answers(run, case, sent)

    def judged(heard: Received, sent: int) -> Axis:
        return _judge_heard(run, case, heard, sent, filled)

    trial.begin(case, {"answer": judged(heard, sent)}, heard, sent)
    if not case.truncated:
        run.profile.measured(heard, sent)
    # After a truncated frame the line was silent for the time-out, however early its answer came.
    whole = heard.answers and not case.truncated
    answered = heard.answers[-1][0] if whole else heard.now
    if not looks:
        if case.stop:
            trial.axes["stop"] = run.config.not_observable("stopped")
        trial.axes["state"] = run.config.not_observable(state_words(trial.expected.state))
    elif case.stop:
        yield from _stop(trial, case, answered)
    else:
        yield from _state(trial, case)
    if case.then:
        # The valid instruction right after a fault is answered, and takes effect.
        yield from _step(trial, case.then, judge(run.protocol, case.then).name)
        if looks and run.config.observable:
            yield from _moves_again(trial, case.then)
    elif case.stop and (yield from stays_stopped(trial, case, looks, judged)):
        yield from restart_guard(trial, case, looks)


def _precondition(run: Run, case: Case, looks: bool) -> Procedure[tuple[SetUp, Received]]:
    """Bring the robot to the case's initial state (the preamble).

    Returns how far that came, and the answers that came without an instruction.
    """
    setup = preamble_of(run, case)
    ready = yield from set_up(run, setup)
    if not ready.missing and looks and case.setup.moving:
        motion = run.protocol.car.drive(case.setup).motion
        moves = run.profile.moves is None or motion in run.profile.moves
        patience = run.timers.deadline if moves else 0
        seen = yield from watch(run, moving=True, patience=patience)
        if seen.look.moving is False and setup != case.setup:
            run.profile.preamble_speed = None
            yield from home(run)
            return (yield from _precondition(run, case, looks))
        ready = ready._replace(look=seen.look)
        if not seen.look.moving:
            missing = f"not seen moving ({motion}) before the stimulus"
            ready = ready._replace(missing=missing)
    stray = yield from listen(None, 0)
    return ready, stray


def _answers(run: Run, case: Case, sent: int) -> Procedure[tuple[Received, bool]]:
    """Receive the due answers; return them, and whether a pad byte was sent to get them."""
    due = len(case.accepted[0].codes)
    if case.truncated:
        # Nothing is sent during its whole time-out.
        waiting = run.waiting
        if run.profile.truncation_answered is False:
            return (yield from listen(None, waiting.silence)), False
        heard = yield from waiting.answers(due, waiting.silence + waiting.usual)
        return (yield from waiting.left_alone(heard, sent)), False
    if not case.short:
        return (yield from run.waiting.answers(due)), False
    # No answer for half a time-out: a slow device, or one that waits for data not announced.
    heard = yield from listen(due, run.waiting.timeout // 2)
    if len(heard.answers) >= due:
        return heard, False
    yield from send(bytes([run.protocol.pad_byte]))
    heard += yield from run.waiting.answers(due + 1)
    return heard, True


def _judge_heard(run: Run, case: Case, heard: Received, sent: int, filled: bool) -> Axis:
    """The answer axis of the answers so far; `filled` if a pad byte was sent after the frame."""
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
        heard = Received(tuple(own), heard.now)
    timed = not case.truncated
    return judge_answers(run.protocol, case.accepted, heard, sent, timed=timed, timers=run.timers)


def _stop(trial: Trial, case: Case, answered: int) -> Procedure[None]:
    """Judge the stop axis (the robot stands once the answer is there) and the state after it."""
    run = trial.run
    longest = int(run.protocol.timing.stop_longest * MS)
    seen = yield from watch(run, moving=False, patience=longest, trial=trial)
    words, reading = look_words(seen.look), "R-stop-latency"
    late = seen.asked - answered
    if seen.look.moving is None:
        axis = Axis(Verdict.INCONCLUSIVE, "stopped", words, NOT_OBSERVABLE)
    elif seen.look.moving:
        reason = f"still moves {late / MS:.0f} ms after its answer was due"
        axis = Axis(Verdict.FAIL, "stopped", words, reason, reading)
    elif late > run.timers.grace:
        run.profile.stop_latency = max(run.profile.stop_latency, late)
        reason = f"stopped only {late / MS:.0f} ms after its answer"
        axis = Axis(Verdict.NON_STRICT, "stopped", words, reason, reading)
    else:
        axis = Axis(Verdict.PASS, "stopped", words)
    trial.axes["stop"] = axis
    trial.axes["state"] = _judge_state(trial, case, seen)


def _state(trial: Trial, case: Case) -> Procedure[None]:
    """Judge the state axis of an instruction that need not stop: observe until the state fits."""
    run = trial.run
    seen = yield from observe()
    start = seen.asked
    axis = _judge_state(trial, case, seen)
    patience = run.timers.deadline
    while axis.verdict is Verdict.FAIL and seen.now - start < patience:
        heard = yield from listen(None, 10 * MS)
        trial.hear(heard)
        seen = yield from observe()
        axis = _judge_state(trial, case, seen)
    if axis.verdict is Verdict.FAIL:
        run.waiting.in_vain(patience)
    trial.axes["state"] = axis


def _judge_state(trial: Trial, case: Case, seen: Observation) -> Axis:
    run = trial.run
    car, expected = run.protocol.car, trial.expected
    for name in (car.speed, car.steering):
        # A probe that shows 0 may not follow at all.
        value = getattr(expected.state, name)
        if value and name not in expected.unknown and getattr(seen.look, name) == value:
            run.followed.add(name)
    of_motion = facets_of_motion(run.protocol)
    elsewhere = of_motion if case.stop and seen.look.moving else ()
    axis = judge_state(run.model, expected, seen.look, elsewhere)
    trial.already = ""
    if axis.verdict is Verdict.FAIL:
        trial.already = _already(trial, case, seen.look, elsewhere)
        reading, why = contradiction(run.model, trial.before, case.frame_effect, seen.look)
        if why:
            axis = Axis(axis.verdict, axis.expected, axis.actual, why, reading)
    if axis.verdict is Verdict.FAIL and run.profile.moves == set():
        # Motor power explains the wheels, and settings that show in them; not the others.
        motor = {*of_motion, car.speed, car.steering} - run.followed
        others = judge_state(run.model, expected, seen.look, motor)
        if others.verdict is Verdict.FAIL:
            return others
        reason = "never seen moving in any kind of motion: is the motor power on?"
        return Axis(Verdict.INCONCLUSIVE, axis.expected, axis.actual, reason)
    blind = unseen(run.protocol, case, seen.look)
    if blind and axis.verdict < Verdict.INCONCLUSIVE:
        reason = f"{NOT_OBSERVABLE}: {blind}"
        return Axis(Verdict.INCONCLUSIVE, axis.expected, axis.actual, reason)
    return axis


def _already(trial: Trial, case: Case, look: Look, ignore: Container[str]) -> str:
    """What was wrong before the stimulus in the same way, with the preamble; "" if nothing was."""
    model, of_motion = trial.run.model, facets_of_motion(trial.run.protocol)
    if trial.look_before is None:
        return ""
    wrong = [d for d in differences(model, trial.expected, look) if d[0] not in ignore]
    earlier = {d[0]: d for d in differences(model, trial.before, trial.look_before)}
    effect = case.frame_effect.effect or trial.run.protocol.on_fault
    kept = [d for d in wrong if earlier.get(d[0]) == d]
    for facet, wanted, actual in wrong:
        own = effect.sets(model.protocol.car.by if facet in of_motion else facet)
        # The wheels show a wrong steering at each speed otherwise.
        follows = facet == "wheels" and facet in earlier
        if own or not (follows or (facet, wanted, actual) in kept):
            return ""
    named = next((d for d in kept if d[0] != "wheels"), earlier[wrong[0][0]])
    preamble = " | ".join(map(spaced, trial.preamble))
    return (
        f"already so before the frame under test, after its preamble {preamble}: "
        f"{deviation(*named)}"
    )


def unseen(protocol: Protocol, case: Case, look: Look) -> str:
    """Which facets this case tests that the look does not show, as words; "" if none."""
    if look.moving is None:
        return "the probe does not know whether the robot moves"
    if case.kind is not FrameClass.VALID:
        return ""
    car = protocol.car
    before, after = case.setup, case.expected
    changed = [n for n in protocol.settings if getattr(after, n) != getattr(before, n)]
    tested = [*changed, car.by] if after.moving else changed
    return untold(protocol, tested, facets_of(protocol, look))


def stays_stopped(
    trial: Trial, case: Case, looks: bool, judged: Callable[[Received, int], Axis]
) -> Procedure[bool]:
    """Check that no more answers come and that the stop holds; `judged` judges all the answers.

    Returns whether the checks that follow (`restart_guard`) can be made.
    """
    run = trial.run
    # Of the many faulty frames, one in eight waits for silence: a late answer shows in the next
    # homing, and a stop that does not last shows in the sequences too.
    many = case.kind is not FrameClass.VALID and not case.thorough
    brief = many and run.counters.next_check() % 8
    window = run.waiting.settle if brief else max(run.timers.silence, run.timers.settle)
    costly = run.config.observability.costly
    hold = 0 if costly else run.counters.hold(case, run.timers)
    rounds = max(1, hold // window)
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
    seen = yield from watch(run, moving=expected_state.state.moving, trial=trial)
    words = look_words(seen.look)
    if any(facet == "moving" for facet, _, _ in differences(run.model, expected_state, seen.look)):
        trial.worsen("state", Verdict.FAIL, words, f"{name} after the fault did not move it")
        return
    axis = judge_state(run.model, expected_state, seen.look)
    reason = f"{name} after the fault: {axis.reason}"
    trial.worsen("state", axis.verdict, words, reason, axis.reading)
