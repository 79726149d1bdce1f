"""Effects: what a device does at the frames of its trigger, each a word with its arguments.

`EFFECTS` has the function of each word. It takes the arguments and returns the change to the
reaction of a conforming device. Effects on more than the reaction are in `hooks.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from operator import floordiv, xor
from typing import Any, TypeVar

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Event, History, MutatedDevice, React, Reaction, answers
from bilprov.conformance.mutation.triggers import OUTCOME_WORDS, OUTCOMES, Trigger, trigger
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.readings import POINTS, Behaviour

Maker = TypeVar("Maker", bound=Callable[..., React])
Change = TypeVar("Change", bound=React)

EFFECTS: dict[str, Callable[..., React]] = {}
WATCHING: dict[str, Callable[..., React]] = {}
"""Effects that see every frame: their first argument is the trigger."""


def _word(name: str) -> str:
    return name.strip("_").replace("_", "-")


def effect(make: Maker) -> Maker:
    """Enter the function of a word: its name, with hyphens."""
    EFFECTS[_word(make.__name__)] = make
    return make


def plain(change: Change) -> Change:
    """Enter the change of a word without arguments."""
    EFFECTS[_word(change.__name__)] = lambda: change
    return change


# -- on the answers ------------------------------------------------------------------------------


@effect
def answers_with(*codes: int) -> React:
    """Return an effect: these codes are answered instead."""
    return lambda device, event, reaction: answers(reaction, *codes)


@effect
def answers_as(outcome: str) -> React:
    """Return an effect: the code of that outcome is answered."""
    return lambda device, event, reaction: answers(
        reaction, device.protocol.answers[OUTCOMES[outcome]].code
    )


@plain
def silent(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: nothing is answered."""
    return answers(reaction)


@plain
def answers_as_before(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: the code due to the frame before is answered, if there was one."""
    return answers(reaction, event.previous.response.code) if event.previous else reaction


@plain
def answers_as_first(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: the code is answered that the first frame with this effect got."""
    return answers(reaction, device.memory.setdefault("code", event.judgement.response.code))


@effect
def adds_to_code(number: int) -> React:
    """Return an effect: so much is added to each code."""
    return lambda device, event, reaction: answers(
        reaction, *(code + number & 0xFF for _, code in reaction.answers)
    )


@plain
def codes_reversed(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: the codes of faults are answered in the wrong order."""
    codes = sorted(device.protocol.codes)
    return answers(reaction, *(codes[len(codes) - codes.index(c)] for _, c in reaction.answers))


@effect
def answers_again(milliseconds: float) -> React:
    """Return an effect: the code comes again that much later, unless another frame comes first."""
    return lambda device, event, reaction: replace(
        reaction, unasked=((int(milliseconds * MS), event.judgement.response.code),)
    )


@effect
def answers_later(milliseconds: float, *codes: int) -> React:
    """Return an effect: these codes come that much later, unless another frame comes first."""
    return lambda device, event, reaction: replace(
        reaction, unasked=tuple((int(milliseconds * MS), code) for code in codes)
    )


@effect
def also_answers(milliseconds: float, *codes: int) -> React:
    """Return an effect: these codes follow that much later, whatever comes between."""
    return lambda device, event, reaction: replace(
        reaction,
        answers=(*reaction.answers, *((int(milliseconds * MS), code) for code in codes)),
    )


@effect
def twice(milliseconds: float = 0) -> React:
    """Return an effect: the answers come, and once more that much later."""
    return lambda device, event, reaction: replace(
        reaction,
        answers=(
            *reaction.answers,
            *((delay + int(milliseconds * MS), code) for delay, code in reaction.answers),
        ),
    )


@effect
def late(milliseconds: float) -> React:
    """Return an effect: the answers come that much later."""
    return lambda device, event, reaction: answers(
        reaction, *(code for _, code in reaction.answers), delay=int(milliseconds * MS)
    )


@effect
def late_one_at_a_time(milliseconds: float) -> React:
    """Return an effect: each frame takes that long, and the next begins with its answer."""
    return _answers_at(lambda event, free: free + int(milliseconds * MS))


@effect
def late_in_order(milliseconds: float) -> React:
    """Return an effect: faults are answered that much later, and no answer overtakes another."""
    wait = int(milliseconds * MS)
    return _answers_at(lambda e, free: free if e.judgement.valid else max(free, e.now + wait))


def _answers_at(time: Callable[[Event, int], int]) -> React:
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


# -- on the state --------------------------------------------------------------------------------


@plain
def drives_on(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: the state stays as it was before the frame."""
    return replace(reaction, state=event.before)


@plain
def starts_driving(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: a stopped robot drives forward."""
    stopped = event.before.motion is Motion.STOPPED
    return sets("motion", Motion.FORWARD)(device, event, reaction) if stopped else reaction


@plain
def only_forward(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: a robot that moves drives forward."""
    return (
        sets("motion", Motion.FORWARD)(device, event, reaction)
        if reaction.state.moving
        else reaction
    )


@plain
def stands_still(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: the robot stops."""
    return replace(reaction, state=replace(reaction.state, motion=Motion.STOPPED))


@effect
def does(*names: str) -> React:
    """Return an effect: what another of these instructions does is done instead."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        other = next(name for name in names if name != event.judgement.name)
        state = device.protocol.by_name[other].effect.apply(event.before)
        return replace(reaction, state=state)

    return react


@effect
def shows_low_bits(mask: int) -> React:
    """Return an effect: the LED shows those bits of the first field that the mask has."""
    return lambda device, event, reaction: replace(
        reaction, state=replace(reaction.state, led=event.judgement.fields[0][1] & mask)
    )


def changes(variable: str, value: Callable[[Any, Any], Any]) -> React:
    """Return an effect: a variable's value is made from the correct one and the one before."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        state = reaction.state
        changed = value(getattr(state, variable), getattr(event.before, variable))
        return replace(reaction, state=replace(state, **{variable: changed}))

    return react


@effect
def sets(variable: str, value: Any) -> React:
    """Return an effect: the variable has this value afterwards."""
    given = Motion(value) if variable == "motion" else value
    return changes(variable, lambda correct, before: given)


@effect
def keeps(variable: str) -> React:
    """Return an effect: the variable stays as it was before the frame."""
    return changes(variable, lambda correct, before: before)


@effect
def mirrors(variable: str) -> React:
    """Return an effect: the variable gets the other sign."""
    return changes(variable, lambda correct, before: -correct)


@effect
def adds_up(variable: str, most: int) -> React:
    """Return an effect: the value is added to the one before, up to a limit on both sides."""
    return changes(variable, lambda correct, before: min(max(correct + before, -most), most))


@effect
def signed(variable: str) -> React:
    """Return an effect: sizes above 127 count as negative; a speed stays positive."""

    def turned(correct: int, before: int) -> int:
        size = abs(correct)
        value = (256 - size) * (-1 if correct > 0 else 1) if size > 127 else correct
        return abs(value) if variable == "speed" else value

    return changes(variable, turned)


def resizes(size: Callable[[int, int], int]) -> Callable[[str, int], React]:
    """Return an effect that makes a variable's size from the correct one; its sign stays."""

    def make(variable: str, number: int) -> React:
        return changes(
            variable,
            lambda correct, _: -size(-correct, number) if correct < 0 else size(correct, number),
        )

    return make


EFFECTS |= {
    "sets-bit": resizes(lambda size, bit: size | 1 << bit),
    "clears-bit": resizes(lambda size, bit: size & ~(1 << bit)),
    "turns-bits": resizes(xor),
    "divides": resizes(floordiv),
    "reverses-bits": resizes(lambda size, width: int(f"{size:0{width}b}"[::-1], 2)),
    "lowers": resizes(lambda size, step: max(0, size - step)),
}


# -- on the state, in time -----------------------------------------------------------------------


@effect
def stops_after(milliseconds: float) -> React:
    """Return an effect: the state changes that much later, if no frame comes before."""
    return lambda device, event, reaction: replace(
        reaction, state=event.before, later=((int(milliseconds * MS), reaction.state),)
    )


@effect
def stops_after_the_answer(milliseconds: float) -> React:
    """Return an effect: the state changes that much after the answer."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        answered = max((delay for delay, _ in reaction.answers), default=0)
        stops = (answered + int(milliseconds * MS), reaction.state)
        return replace(reaction, state=event.before, later=(stops,))

    return react


@effect
def resumes_after(milliseconds: float) -> React:
    """Return an effect: the state from before the frame returns that much later."""
    return lambda device, event, reaction: replace(
        reaction, later=((int(milliseconds * MS), event.before),)
    )


@effect
def jerks(begin: float, end: float) -> React:
    """Return an effect: the state from before the frame returns between these times (ms)."""
    return lambda device, event, reaction: replace(
        reaction, later=((int(begin * MS), event.before), (int(end * MS), reaction.state))
    )


@effect
def watchdog(milliseconds: int, resumes: int | None = None) -> React:
    """Return an effect: without another frame the robot stops `milliseconds` later.

    After `resumes` ms it drives on; never if that is None.
    """

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if not reaction.state.moving:
            return reaction
        stopped = replace(reaction.state, motion=Motion.STOPPED)
        later = ((milliseconds * MS, stopped), ((resumes or 0) * MS, reaction.state))
        return replace(reaction, later=later if resumes else later[:1])

    return react


# -- on both, and effects that remember ----------------------------------------------------------


def at(acting: Trigger, change: React) -> React:
    """Return an effect that makes the change at the frames of the trigger."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        holds = acting.holds(event, device.memory)
        return change(device, event, reaction) if holds else reaction

    return react


def then(*changes: React) -> React:
    """Return an effect that makes the changes one after the other."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        for change in changes:
            reaction = change(device, event, reaction)
        return reaction

    return react


def behind(loses: React, reacts: React) -> React:
    """Return an effect: a frame that the first one loses is not reacted to, any other is."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        left = loses(device, event, reaction)
        return reacts(device, event, reaction) if left is reaction else left

    return react


accepts = EFFECTS["accepts"] = lambda: then(drives_on, answers_as("valid"))
loses = EFFECTS["loses"] = lambda: then(drives_on, silent)


def as_if(device: MutatedDevice, event: Event, reaction: Reaction, frame: bytes) -> Reaction:
    """Return the reaction of a conforming device to another frame."""
    judgement, state = device.step(frame, event.before)
    return replace(answers(reaction, judgement.response.code), state=state)


@effect
def takes_for(name: str, *ids: int) -> React:
    """Return an effect: these IDs stand for the instruction."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        judgement, protocol = event.judgement, device.protocol
        if judgement.id not in ids:
            return reaction
        own = protocol.header_bytes[protocol.by_name[name].id, judgement.length]
        return as_if(device, event, reaction, bytes([own]) + judgement.frame[1:])

    return react


@effect
def knows_no(name: str) -> React:
    """Return an effect: the instruction's ID is an unused one."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        judgement, protocol = event.judgement, device.protocol
        if judgement.id != protocol.by_name[name].id:
            return reaction
        unused = protocol.header_bytes[protocol.unused_ids[-1], judgement.length]
        return as_if(device, event, reaction, bytes([unused]) + judgement.frame[1:])

    return react


@effect
def has_forgotten(variable: str) -> React:
    """Return an effect: the frame is carried out as if the variable had been 0 before it."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        before = replace(event.before, **{variable: 0})  # type: ignore[arg-type]
        return replace(reaction, state=device.step(event.judgement.frame, before)[1])

    return react


@effect
def swapped_header() -> React:
    """Return an effect: ID and length change places; what fits no instruction is an unknown ID."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        protocol = device.protocol
        spec = protocol.by_id.get(event.judgement.length)
        if spec is None or event.judgement.id != spec.length:
            code = protocol.answers[Outcome.UNKNOWN_ID].code
            return replace(answers(reaction, code), state=protocol.on_fault.apply(event.before))
        fields = {part.name: part.low for part in spec.fields}
        ok = protocol.answers[Outcome.VALID].code
        return replace(answers(reaction, ok), state=spec.effect.apply(event.before, fields))

    return react


@effect
def queue(room: int) -> React:
    """Return an effect: of frames sent ahead so many have room, each further one is lost."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        waiting = device.memory.get("waiting", 0) + 1 if event.pipelined else 1
        device.memory["waiting"] = min(waiting, room + 1)
        return loses()(device, event, reaction) if waiting > room else reaction

    return react


@plain
def lost_behind_a_fault(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: frames pipelined behind a fault are lost, until the host waits for an answer."""
    lost = event.pipelined and "lost" in device.memory
    if not lost:
        device.memory.pop("lost", None)
    if not event.judgement.valid:
        device.memory["lost"] = 1
    return loses()(device, event, reaction) if lost else reaction


def restarts(acting: Trigger, settings: int = 0) -> React:
    """Return an effect: the motion that the last fault ended resumes at a frame of the trigger.

    `settings` is the number of valid frames since then at which it resumes; 0 for any. An
    instruction that sets the motion ends the wait.
    """

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        memory, valid = device.memory, event.judgement.valid
        if not valid and event.before.moving:
            memory["motion"] = list(Motion).index(event.before.motion)
            memory["settings"] = 0
            return reaction
        instruction = event.judgement.instruction
        if valid and instruction and instruction.effect.sets("motion"):
            memory.pop("motion", None)
        if "motion" not in memory:
            return reaction
        if valid:
            memory["settings"] = min(memory["settings"] + 1, settings + 1)
        if not acting.holds(event, memory) or (settings and memory["settings"] != settings):
            return reaction
        motion = list(Motion)[memory.pop("motion")]
        return replace(reaction, state=replace(reaction.state, motion=motion))

    return react


_SPEED_TO_COME = "speed to come"


def speed_at_next_motion(acting: Trigger) -> React:
    """Return an effect: a speed sent while moving applies from the next motion instruction."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        memory, known = device.memory, event.judgement.instruction
        if known is None or not event.judgement.valid:
            return reaction
        effect, moving = known.effect, event.before.motion is not Motion.STOPPED
        if effect.sets("speed") and not effect.sets("motion"):
            memory.pop(_SPEED_TO_COME, None)
            if moving and acting.holds(event, memory):
                memory[_SPEED_TO_COME] = reaction.state.speed
                return keeps("speed")(device, event, reaction)
        elif _SPEED_TO_COME in memory and effect.motion not in (None, Motion.STOPPED):
            return sets("speed", memory.pop(_SPEED_TO_COME))(device, event, reaction)
        return reaction

    return react


WATCHING |= {_word(make.__name__): make for make in (restarts, speed_at_next_motion)}


# -- choices at open points ----------------------------------------------------------------------


@effect
def chooses(point: str, word: str) -> React:
    """Return an effect: where this open point arises, the device makes the choice of that word."""
    open_point = POINTS[point.replace(":", " ")]
    choice = open_point.choice(word)
    assert choice is not None
    return at(trigger(f"open {point}"), _making(choice.does, open_point.variable))


def _making(does: Outcome | Behaviour | None, variable: str) -> React:
    """Return the effect of the behaviour of a choice."""
    if isinstance(does, Outcome):
        return answers_as(OUTCOME_WORDS[does])
    if does is Behaviour.SILENT:
        return silent
    if does is Behaviour.KEPT:
        return keeps(variable)
    zeroed = sets(variable, 0)
    return then(zeroed, _forgets_the_speed_to_come) if variable == "speed" else zeroed


def _forgets_the_speed_to_come(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    device.memory.pop(_SPEED_TO_COME, None)
    return reaction


@plain
def takes_low_bits(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: accept the data, use the bits that have a meaning and ignore the others."""
    known = event.judgement.instruction
    assert known is not None
    fields = {
        part.name: value & part.high
        for part, (_, value) in zip(known.fields, event.judgement.fields, strict=True)
    }
    ok = device.protocol.answers[Outcome.VALID].code
    return replace(answers(reaction, ok), state=known.effect.apply(event.before, fields))


HISTORIES = {
    "answers-as-before": History(
        previous=(lambda judgement, kind: judgement and judgement.response.code,)
    ),
    "queue": History(timed=True),
    "lost-behind-a-fault": History(timed=True),
}
"""What effects read of the frames before."""
