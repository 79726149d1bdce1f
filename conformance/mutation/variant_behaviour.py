"""Behaviour of the legal variants, as changes to the reaction of the reference device.

Their names, descriptions and options stand in `variants.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Event, Hear, MutatedDevice, React, Reaction, answers
from bilprov.conformance.mutation.faults.vocabulary import (
    Condition,
    answers_with,
    keeps,
    sets,
    then,
)
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import MOTIONS, Moment, Motion, moment_of, rotates
from bilprov.spec.open_points import open_point, points_after
from bilprov.spec.readings import POINTS, Behaviour, OpenPoint

# Says whether a device takes the other choice now, from the device and the ID of the frame.
Chooses = Callable[[MutatedDevice, int], bool]
_MEMORY = "speed to come"


def always(device: MutatedDevice, identity: int) -> bool:
    """Take the other choice each time."""
    return True


# -- triggers: frames at which a choice shows ----------------------------------------------------


def moment(event: Event) -> Moment:
    """Return the kind of a frame: faulty, or what its instruction does to the motion."""
    instruction = event.judgement.instruction
    return moment_of(instruction.effect if event.judgement.valid and instruction else None)


def sets_variable(event: Event, name: str) -> bool:
    """Return whether a valid frame sets the variable and leaves the motion."""
    instruction = event.judgement.instruction
    known = instruction is not None and instruction.effect.sets(name)
    return known and moment(event) is Moment.SETTING


def steers_while_rotating(event: Event) -> bool:
    """Trigger: a valid steering instruction during a rotation."""
    return sets_variable(event, "steering") and rotates(event.before.motion)


def out_of_bits(event: Event) -> bool:
    """Trigger: bad data of an instruction with named bits: a bit without meaning is set."""
    known = event.judgement.instruction
    bits = known is not None and any(part.bits for part in known.fields)
    return bits and event.judgement.outcome is Outcome.BAD_DATA


# -- effects: what the device then does ----------------------------------------------------------


def only(condition: Condition, change: React, chooses: Chooses) -> React:
    """Return an effect that makes the change if the trigger holds and the device chooses it."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if condition(event) and chooses(device, event.judgement.id):
            return change(device, event, reaction)
        return reaction

    return react


def choosing(words: Mapping[str, str], chooses: Chooses) -> React:
    """Return an effect: the device makes the choice of a word at each of these open points."""
    changes = {ident: _making(POINTS[ident], word) for ident, word in words.items()}

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        state_points = (point.id for point in points_after(moment(event)).values())
        points = (open_point(event.judgement), *state_points)
        made = [changes[point] for point in points if point in changes]
        if made and chooses(device, event.judgement.id):
            return then(*made)(device, event, reaction)
        return reaction

    return react


def _making(point: OpenPoint, word: str) -> React:
    """Return the effect of the choice of that word."""
    does = next(choice.does for choice in point.choices if choice.word == word)
    if isinstance(does, Outcome):
        return lambda device, event, reaction: answers(reaction, device.protocol.answers[does].code)
    if does is Behaviour.SILENT:
        return answers_with()
    if does is Behaviour.KEPT:
        return keeps(point.variable)
    zeroed = sets(**{point.variable: 0})
    return then(zeroed, _forgets_the_speed_to_come) if point.variable == "speed" else zeroed


def _forgets_the_speed_to_come(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    device.memory.pop(_MEMORY, None)
    return reaction


def low_bits(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: accept the data, use the bits that have a meaning and ignore the others."""
    known = event.judgement.instruction
    assert known is not None
    fields = {
        part.name: value & part.high
        for part, (_, value) in zip(known.fields, event.judgement.fields, strict=True)
    }
    state = known.effect.apply(event.before, fields)
    return replace(answers(reaction, device.protocol.answers[Outcome.VALID].code), state=state)


def speed_at_next_motion(chooses: Chooses) -> React:
    """Return an effect: a speed sent while moving applies from the next motion instruction."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if sets_variable(event, "speed"):
            device.memory.pop(_MEMORY, None)
            if event.before.motion is not Motion.STOPPED and chooses(device, event.judgement.id):
                device.memory[_MEMORY] = reaction.state.speed
                return replace(reaction, state=replace(reaction.state, speed=event.before.speed))
        if _MEMORY in device.memory and moment(event) in MOTIONS:
            return sets(speed=device.memory.pop(_MEMORY))(device, event, reaction)
        return reaction

    return react


def answers_at(time: Callable[[Event, int], int]) -> React:
    """Return an effect: the answers come at the time (ns) that the function gives.

    It gets the frame and the time at which the device is free: that of the answer before, or now.
    A frame without an answer takes no time.
    """

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if not reaction.answers:
            return reaction
        free = max(event.now, device.memory.get("answered at", 0))
        due = device.memory["answered at"] = time(event, free)
        return answers(reaction, *(code for _, code in reaction.answers), delay=due - event.now)

    return react


def lost_behind_a_fault(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: frames pipelined behind a fault are lost, until the host waits for an answer."""
    lost = event.pipelined and "lost" in device.memory
    if not lost:
        device.memory.pop("lost", None)
    if not event.judgement.valid:
        device.memory["lost"] = 1
    return replace(reaction, answers=(), state=event.before) if lost else reaction


def flushing(pause: int, condition: Condition, chooses: Chooses) -> tuple[React, Hear]:
    """Return hooks that drop all bytes after such a fault until the line is idle for `pause` ms."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        faulty = not event.judgement.valid
        if faulty and condition(event) and chooses(device, event.judgement.id):
            device.memory["idle at"] = event.now + pause * MS
        return reaction

    def hear(device: MutatedDevice, data: bytes, now: int) -> bytes:
        if now < device.memory.get("idle at", now):
            device.memory["idle at"] = now + pause * MS
            return b""
        device.memory.pop("idle at", None)
        return data

    return react, hear


def behind(loses: React, reacts: React) -> React:
    """Return an effect: a frame that the first one loses is not reacted to, any other is."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        left = loses(device, event, reaction)
        return reacts(device, event, reaction) if left is reaction else left

    return react


def stops_late(milliseconds: int) -> React:
    """Return an effect: a moving robot stops that much after the answer to a fault."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if event.judgement.valid or not event.before.moving:
            return reaction
        answered = max((delay for delay, _ in reaction.answers), default=0)
        stops = (answered + milliseconds * MS, reaction.state)
        return replace(reaction, state=event.before, later=(stops,))

    return react


def at_the_header(chooses: Chooses) -> Hear:
    """Return a hook that answers a wrong header at once and drops the data of that frame.

    The data end when all have come, or after a pause that truncates a frame.
    """

    def hear(device: MutatedDevice, data: bytes, now: int) -> bytes:
        memory, protocol = device.memory, device.protocol
        if memory.get("skips"):
            pause = device.timeouts[memory["skips of"]]
            if pause is None or now < memory["skips at"] + pause:
                memory["skips"], memory["skips at"] = memory["skips"] - 1, now
                return b""
        for name in ("skips", "skips of", "skips at"):
            memory.pop(name, None)
        identity, length = protocol.headers[data[0]]
        known = protocol.by_id.get(identity)
        wrong = length > 0 and (known is None or length != known.length)
        if not wrong or device.held or not chooses(device, identity):
            return data
        memory["skips"], memory["skips of"], memory["skips at"] = length, data[0], now
        device.react_at_header(data + bytes(length), now)
        return b""

    return hear


def stops_at_an_unused_header(device: MutatedDevice, header: int) -> tuple[int, ...]:
    """Stop the robot at the header of an unused ID; of a wrong length only after its data."""
    identity, _ = device.protocol.headers[header]
    known = identity in device.protocol.by_id
    return () if known else stops_at_the_header(device, header)


def stops_at_the_header(device: MutatedDevice, header: int) -> tuple[int, ...]:
    """Stop the robot at a wrong header; the answer comes after the data, as usual."""
    identity, length = device.protocol.headers[header]
    known = device.protocol.by_id.get(identity)
    if known is None or length != known.length:
        device.state = replace(device.state, motion=Motion.STOPPED)
    return ()
