"""Records the choices a device shows in its first frames after power-on.

This comes before the line is homed, because the stops of homing reset the state. A device that
makes one choice in its first frames and another later contradicts itself: the experiments of
`discovery` are compared with what is recorded here.
"""

from __future__ import annotations

from bilprov.analyzer.client.operations import Procedure, Received, listen, send
from bilprov.captures.schemas import Look
from bilprov.conformance.cases.case import case_of_the_run, full_state
from bilprov.conformance.cases.steps import code_of, step_of
from bilprov.conformance.oracle.judge import differences, look_words
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.runner.homing import set_up, watch
from bilprov.conformance.runner.run import Run
from bilprov.spec.by_effect import movers, moving_to
from bilprov.spec.fields import Outcome
from bilprov.spec.open_points import open_after
from bilprov.spec.readings import Behaviour
from bilprov.spec.state import Effect, State

_CASE = "the first frames after power-on"


def first_choices(run: Run) -> Procedure[None]:
    """Record what the first fault and the first stop leave of speed, steering and LED.

    Only unambiguous observations count: every answer right, the robot in the state set up before.
    """
    protocol = run.protocol
    mover = next(iter(movers(protocol)), None)
    if mover is None or not run.config.observable:
        return
    full = full_state(protocol, mover)
    fault = protocol.header_bytes.get((protocol.unused_ids[0], 0)) if protocol.unused_ids else None
    stop = protocol.header_bytes[protocol.stop.id, 0]
    if fault is not None and run.config.power and "pipelining" not in run.profile.choices.allowed:
        yield from _sent_ahead(run, bytes([fault, stop, stop]))
    ok = code_of(protocol, Outcome.VALID)
    rows: list[tuple[int, int, Effect | None]] = [(stop, ok, protocol.stop.effect)]
    if fault is not None:
        rows.insert(0, (fault, code_of(protocol, Outcome.UNKNOWN_ID), None))
    if not (yield from _drives_on(run, full)):
        return
    for frame, code, effect in rows:
        heard = yield from _sent_in(run, full, bytes([frame]))
        if heard is None or heard.codes != (code,):
            return
        seen = yield from watch(run, moving=False, patience=run.timers.deadline)
        if seen.look.moving and effect is None:
            _missed(run, bytes([frame]), seen.look)
        if seen.look.moving is not False:
            return
        _settle(run, effect, full, seen.look)
        yield from listen(None, run.timers.settle)


def _sent_ahead(run: Run, burst: bytes) -> Procedure[None]:
    """Record whether stops sent right behind the first fault after power-on are lost."""
    yield from send(burst)
    heard = yield from run.waiting.all_answers(len(burst))
    if heard.codes == (code_of(run.protocol, Outcome.UNKNOWN_ID),):
        run.profile.choices.record("R-pipelining unused-id", "lost-after-fault", _CASE)
        yield from listen(None, run.waiting.idle)


def _drives_on(run: Run, full: State) -> Procedure[bool]:
    """Record what a motion instruction leaves of the steering; false where that is ambiguous."""
    frame = moving_to(run.protocol, full)
    if not frame:
        return False
    heard = yield from _sent_in(run, full, frame)
    if heard is None:
        return False
    seen = yield from watch(run, moving=True, patience=run.timers.deadline)
    if heard.codes != (code_of(run.protocol, Outcome.VALID),) or not seen.look.moving:
        return False
    _settle(run, step_of(run.protocol, frame).frame_effect.effect, full, seen.look)
    return True


def _sent_in(run: Run, full: State, frame: bytes) -> Procedure[Received | None]:
    """The answers to a frame that is sent in this state, None where it is not seen."""
    ready = yield from set_up(run, full)
    if ready.missing:
        return None
    seen = yield from watch(run, moving=True, patience=run.timers.deadline)
    if differences(run.model, ready.expected, seen.look):
        return None
    yield from send(frame)
    return (yield from run.waiting.answers(1))


def _missed(run: Run, frame: bytes, look: Look) -> None:
    """Report that the first fault did not stop the robot although its answer was that of a fault.

    A byte changed on the line cannot cause this: a frame without a fault gets another answer. So
    it counts without a retry.
    """
    case = case_of_the_run(run.protocol, "power-on/first-fault", frame)
    reason = "the first fault after power-on was answered and did not stop it"
    fault = Axis(Verdict.FAIL, "stopped", look_words(look), reason)
    run.conclude(case, {"stop": fault})


def _settle(run: Run, effect: Effect | None, full: State, look: Look) -> None:
    """Record what a frame of this effect, None for a fault, leaves open and does."""
    points = open_after(run.protocol, effect)
    for variable, point in points.items():
        seen, was = getattr(look, variable), getattr(full, variable)
        if seen in (0, was) and was:
            does = Behaviour.KEPT if seen == was else Behaviour.RESET
            run.profile.choices.record(point.id, point.word_of(does), _CASE)
