"""What a device shows right after power-on, before the stops that home the line hide it.

A device that chooses one reading for its first frames and another from then on shows two choices:
what it showed first is kept, and the probes of `discovery` are held against it.
"""

from __future__ import annotations

from captures.schemas import Look
from conformance.cases.preamble import moves, moving_to
from conformance.cases.single_frames import special
from conformance.cases.steps import code_of
from conformance.dut.operations import Script, listen, send
from conformance.oracle.choices import POINTS, Choices
from conformance.oracle.judge import differences, look_words
from conformance.oracle.verdicts import Axis, Verdict
from conformance.runner.homing import set_up, watch
from conformance.runner.run import Run
from spec.fields import Outcome
from spec.motion import Motion, State
from spec.protocol import Protocol

_CASE = "the first frames after power-on"
_STOP = {"steering": "R-stop-steering", "speed": "R-stop-speed", "led": "R-led-state stop"}
_FAULT = {
    "steering": "R-fault-state steering",
    "speed": "R-fault-state speed",
    "led": "R-led-state fault",
}


def first_choices(run: Run) -> Script[None]:
    """Settle what the first fault and the first stop leave of speed, steering and LED.

    Only what is seen beyond doubt counts: every answer right, the robot as it was set up before.
    """
    protocol = run.protocol
    full = _full(protocol)
    if full is None or not run.looks_freely:
        return
    fault = protocol.header_bytes.get((protocol.unused_ids[0], 0)) if protocol.unused_ids else None
    stop = protocol.header_bytes[protocol.stop.id, 0]
    if fault is not None and run.power and "pipelining" not in run.profile.choices.allowed:
        yield from _sent_ahead(run, bytes([fault, stop, stop]))
    rows = [(stop, code_of(protocol, Outcome.VALID), _STOP)]
    if fault is not None:
        rows.insert(0, (fault, code_of(protocol, Outcome.UNKNOWN_ID), _FAULT))
    if not (yield from _drives_on(run, full)):
        return
    for frame, code, points in rows:
        if (yield from set_up(run, full)):
            return
        seen = yield from watch(run, moving=True, patience=run.limits.deadline)
        if differences(run.model, run.belief, seen.look):
            return
        yield from send(bytes([frame]))
        heard = yield from run.answers(1)
        if heard.codes != (code,):
            return
        seen = yield from watch(run, moving=False, patience=run.limits.deadline)
        if seen.look.moving and points is _FAULT:
            _missed(run, bytes([frame]), seen.look)
        if seen.look.moving is not False:
            return
        _settle(run.profile.choices, points, full, seen.look)
        yield from listen(None, run.limits.settle)


def _sent_ahead(run: Run, burst: bytes) -> Script[None]:
    """The first fault after power-on, with stops sent ahead behind it: are they lost?"""
    yield from send(burst)
    heard = yield from run.all_answers(len(burst))
    if heard.codes == (code_of(run.protocol, Outcome.UNKNOWN_ID),):
        run.profile.choices.settle("R-pipelining unused-id", "lost-after-fault", _CASE)
        yield from listen(None, run.timeout + run.limits.settle)


def _drives_on(run: Run, full: State) -> Script[bool]:
    """Settle what a motion instruction leaves of the steering; false where a doubt is left."""
    mover = moving_to(run.protocol, full.motion)
    if mover is None or (yield from set_up(run, full)):
        return False
    seen = yield from watch(run, moving=True, patience=run.limits.deadline)
    if differences(run.model, run.belief, seen.look):
        return False
    yield from send(bytes([run.protocol.header_bytes[mover.id, 0]]))
    heard = yield from run.answers(1)
    seen = yield from watch(run, moving=True, patience=run.limits.deadline)
    if heard.codes != (code_of(run.protocol, Outcome.VALID),) or not seen.look.moving:
        return False
    _settle(run.profile.choices, {"steering": "R-drive-steering"}, full, seen.look)
    return True


def _missed(run: Run, frame: bytes, look: Look) -> None:
    """The first fault did not stop it, although the answer says that it was one.

    One byte that the line has changed does not do that: a frame that is none of a fault gets
    another answer. It need not show a second time.
    """
    clause, requirement = run.protocol.clauses.safety, "the first fault stops the robot too"
    case = special(run.protocol, "power-on/first-fault", clause, requirement, frame)
    reason = "the first fault after power-on was answered and did not stop it"
    fault = Axis(Verdict.FAIL, "stopped", look_words(look), reason)
    run.end(case, {"stop": fault})


def _settle(choices: Choices, points: dict[str, str], full: State, look: Look) -> None:
    for variable, ident in points.items():
        seen, was = getattr(look, variable), getattr(full, variable)
        if seen not in (0, was) or not was:
            continue
        # The words of a point are what is left as it was, and what is set back; `kept` or not.
        kept = {"kept", "unchanged"}
        word = next(c.word for c in POINTS[ident].choices if (c.word in kept) is (seen == was))
        choices.settle(ident, word, _CASE)


def _full(protocol: Protocol) -> State | None:
    """A state in which every variable is far from its value at rest, None if nothing moves."""
    mover = next((s for s in protocol.instructions if moves(s) and not s.length), None)
    if mover is None:
        return None
    ends = {name: high for name, (_, high) in protocol.limits.items()}
    motion = mover.effect.motion or Motion.STOPPED
    return State(motion, ends.get("speed", 0), ends.get("steering", 0), ends.get("led", 0))
