"""The other choices that the readings leave open, as changes of the reference device.

What each of them changes, and nothing of names or verdicts: `conformance.variants` has those.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from conformance.dut.fault import MS, Event, Hear, React, Reaction, answers
from conformance.dut.simulator import Simulator
from conformance.mutation.faults.vocabulary import Condition, is_truncated, sets
from spec.fields import Outcome
from spec.motion import WHEELS, Motion
from spec.protocol import Protocol

# Whether a device takes the other choice now: the device, the ID of the frame.
Chooses = Callable[[Simulator, int], bool]
_MEMORY = "speed to come"


def always(device: Simulator, identity: int) -> bool:
    """The other choice each time."""
    return True


def code_of(protocol: Protocol, outcome: Outcome) -> int:
    """The response code of an outcome."""
    return protocol.answers[outcome].code


# -- the frames at which a choice shows ----------------------------------------------------------


def motion_of(event: Event) -> Motion | None:
    """The motion that a valid frame sets, None if it sets none."""
    instruction = event.judgement.instruction
    return instruction.effect.motion if event.judgement.valid and instruction else None


def stops(event: Event) -> bool:
    """A valid instruction that stops it."""
    return motion_of(event) is Motion.STOPPED


def stops_or_fails(event: Event) -> bool:
    """A stop, or any fault."""
    return stops(event) or not event.judgement.valid


def drives(event: Event) -> bool:
    """A valid instruction that sets it moving."""
    return motion_of(event) not in (None, Motion.STOPPED)


def sets_variable(event: Event, name: str) -> bool:
    """A valid instruction that sets the variable and leaves the motion."""
    instruction = event.judgement.instruction
    found = event.judgement.valid and instruction and instruction.effect.sets(name)
    return bool(found) and motion_of(event) is None


def steers_while_rotating(event: Event) -> bool:
    """Steering during a rotation."""
    left, right = WHEELS[event.before.motion]
    return sets_variable(event, "steering") and left != right


def announces_data_for_nobody(event: Event) -> bool:
    """An unused ID with data announced."""
    return event.judgement.outcome is Outcome.UNKNOWN_ID and event.judgement.length > 0


def cut_short_and_unused(event: Event) -> bool:
    """An unused ID that was cut short."""
    return is_truncated(event) and event.judgement.instruction is None


def cut_short_and_too_long(event: Event) -> bool:
    """Cut short, and more was announced than the instruction takes."""
    known = event.judgement.instruction
    return is_truncated(event) and known is not None and event.judgement.length > known.length


def too_many_and_bad(event: Event) -> bool:
    """Too many data bytes, the first of them out of the instruction's range."""
    known = event.judgement.instruction
    if known is None or not known.fields or event.judgement.outcome is not Outcome.TOO_MANY:
        return False
    return any(
        not part.low
        <= part.parse(event.judgement.frame[1 + part.offset :][: part.size])
        <= part.high
        for part in known.fields
    )


def out_of_bits(event: Event) -> bool:
    """Data whose bits that mean nothing are set."""
    known = event.judgement.instruction
    bad = event.judgement.outcome is Outcome.BAD_DATA and known is not None
    return bad and known is not None and any(part.bits for part in known.fields)


# -- what is then done ---------------------------------------------------------------------------


def only(condition: Condition, change: React, chooses: Chooses = always) -> React:
    """The change where the point arises and the device chooses it."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        if condition(event) and chooses(device, event.judgement.id):
            return change(device, event, reaction)
        return reaction

    return react


def straight_into_a_curve(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
    """The rotation becomes a curve."""
    return sets(motion=Motion.FORWARD)(device, event, reaction)


def low_bits(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
    """Takes the bits that mean something and ignores the others."""
    known = event.judgement.instruction
    assert known is not None
    fields = {
        part.name: value & part.high
        for part, (_, value) in zip(known.fields, event.judgement.fields, strict=True)
    }
    state = known.effect.apply(event.before, fields)
    return replace(answers(reaction, code_of(device.protocol, Outcome.VALID)), state=state)


def speed_at_next_motion(chooses: Chooses = always) -> React:
    """A speed that comes while it moves takes effect at the next motion instruction."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        if sets_variable(event, "speed"):
            device.memory.pop(_MEMORY, None)
            if event.before.motion is not Motion.STOPPED and chooses(device, event.judgement.id):
                device.memory[_MEMORY] = reaction.state.speed
                return replace(reaction, state=replace(reaction.state, speed=event.before.speed))
        if _MEMORY in device.memory and drives(event):
            return sets(speed=device.memory.pop(_MEMORY))(device, event, reaction)
        return reaction

    return react


def slow_after_faults(milliseconds: int) -> React:
    """Faults are answered so much later; no answer overtakes the one before it."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        delay = 0 if event.judgement.valid else milliseconds * MS
        at = max(event.now + delay, device.memory.get("answered", 0))
        device.memory["answered"] = at
        return answers(reaction, *(code for _, code in reaction.answers), delay=at - event.now)

    return react


def one_at_a_time(milliseconds: int) -> React:
    """Takes so long for each instruction, and begins the next when it has answered."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        begins = max(event.now, device.memory.get("busy at", 0))
        ready = device.memory["busy at"] = begins + milliseconds * MS
        codes = (code for _, code in reaction.answers)
        return answers(reaction, *codes, delay=ready - event.now)

    return react


def watchdog(milliseconds: int) -> React:
    """Stops by itself when so long no frame has come."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        if not reaction.state.moving:
            return reaction
        stopped = replace(reaction.state, motion=Motion.STOPPED)
        return replace(reaction, later=((milliseconds * MS, stopped),))

    return react


def lost_behind_a_fault(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
    """What was sent ahead behind a fault is lost, until somebody waits."""
    lost = event.pipelined and "lost" in device.memory
    if not lost:
        device.memory.pop("lost", None)
    if not event.judgement.valid:
        device.memory["lost"] = 1
    return replace(reaction, answers=(), state=event.before) if lost else reaction


def flushing(pause: int, condition: Condition, chooses: Chooses = always) -> tuple[React, Hear]:
    """Throws away what follows such a faulty frame until the line was idle for `pause` ms."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        faulty = not event.judgement.valid
        if faulty and condition(event) and chooses(device, event.judgement.id):
            device.memory["idle at"] = event.now + pause * MS
        return reaction

    def hear(device: Simulator, data: bytes, now: int) -> bytes:
        if now < device.memory.get("idle at", now):
            device.memory["idle at"] = now + pause * MS
            return b""
        device.memory.pop("idle at", None)
        return data

    return react, hear


def at_the_header(pause: int, chooses: Chooses = always) -> Hear:
    """Answers a frame that is wrong at its header at once, and takes its data without a word.

    The data are over when all have come, or after a pause of `pause` ms.
    """

    def hear(device: Simulator, data: bytes, now: int) -> bytes:
        memory, protocol = device.memory, device.protocol
        if memory.get("skips") and now < memory["skips at"] + pause * MS:
            memory["skips"], memory["skips at"] = memory["skips"] - 1, now
            return b""
        memory.pop("skips", None)
        memory.pop("skips at", None)
        identity, length = protocol.headers[data[0]]
        known = protocol.by_id.get(identity)
        wrong = length > 0 and (known is None or length != known.length)
        if not wrong or device.held or not chooses(device, identity):
            return data
        if known is None:
            outcome = Outcome.UNKNOWN_ID
        else:
            outcome = Outcome.TOO_MANY if length > known.length else Outcome.TOO_FEW
        memory["skips"], memory["skips at"] = length, now
        device.state = protocol.on_fault.apply(device.state)
        device.answer(code_of(protocol, outcome), now)
        return b""

    return hear


def stops_at_the_header(device: Simulator, header: int) -> tuple[int, ...]:
    """Stops as soon as the header is known to be wrong; the answer comes in its time."""
    identity, length = device.protocol.headers[header]
    known = device.protocol.by_id.get(identity)
    if known is None or length != known.length:
        device.state = device.protocol.on_fault.apply(device.state)
    return ()
