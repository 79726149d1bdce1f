"""Building blocks of faults: triggers (on which frames) and effects (what the device does)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Event, MutatedDevice, React, Reaction, answers
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion, State
from bilprov.spec.protocol import InstructionSpec

Condition = Callable[[Event], bool]
Change = Callable[[Event, State], State]

# The outcomes of faulty frames.
FAULTY = tuple(outcome for outcome in Outcome if outcome is not Outcome.VALID)


def when(matches: Condition, change: React) -> React:
    """Return an effect that makes the change for the frames that match."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        return change(device, event, reaction) if matches(event) else reaction

    return react


# -- triggers: conditions on a frame, the state before it, and its history -----------------------


def every(*conditions: Condition) -> Condition:
    """Return a trigger: all of the conditions hold."""
    return lambda event: all(condition(event) for condition in conditions)


def faulty(event: Event) -> bool:
    """Trigger: any faulty frame."""
    return not event.judgement.valid


def valid(event: Event) -> bool:
    """Trigger: any valid frame."""
    return event.judgement.valid


def is_outcome(outcome: Outcome) -> Condition:
    """Return a trigger: complete frames with that outcome."""
    return lambda event: event.judgement.outcome is outcome and not is_truncated(event)


def is_truncated(event: Event) -> bool:
    """Trigger: frames that the time-out truncated."""
    return event.kind == "truncated"


def is_whole(event: Event) -> bool:
    """Trigger: complete frames."""
    return event.kind == "instruction"


def is_named(*specs: InstructionSpec) -> Condition:
    """Return a trigger: valid frames of one of these instructions."""
    ids = {spec.id for spec in specs}
    return lambda event: event.judgement.valid and event.judgement.id in ids


def has_id(identity: int) -> Condition:
    """Return a trigger: frames with that ID in the header."""
    return lambda event: event.judgement.id == identity


def has_length(length: int) -> Condition:
    """Return a trigger: frames with that number of data bytes in the header."""
    return lambda event: event.judgement.length == length


def carries(spec: InstructionSpec, *values: int) -> Condition:
    """Return a trigger: valid frames of that instruction whose first field has such a value."""
    named = is_named(spec)
    return lambda event: named(event) and event.judgement.fields[0][1] in values


def moving(event: Event) -> bool:
    """Trigger: the robot moved when the frame came."""
    return event.before.moving


def standing(event: Event) -> bool:
    """Trigger: the robot did not move when the frame came."""
    return not event.before.moving


def moving_in(motion: Motion | None) -> Condition:
    """Return a trigger: the robot was in that motion when the frame came."""
    return lambda event: event.before.moving and event.before.motion is motion


def steered_to(sign: int) -> Condition:
    """Return a trigger: it was steered to the right (1) or to the left (-1)."""
    return lambda event: event.before.steering * sign > 0


def after(spec: InstructionSpec) -> Condition:
    """Return a trigger: the frame before was that instruction, and valid."""
    return lambda event: (
        event.previous is not None and event.previous.valid and event.previous.id == spec.id
    )


def after_a_fault(event: Event) -> bool:
    """Trigger: the frame before was faulty."""
    return event.row > 0


def after_outcome(outcome: Outcome) -> Condition:
    """Return a trigger: the frame before, complete or not, was judged so."""
    return lambda event: event.previous is not None and event.previous.outcome is outcome


def after_truncated(event: Event) -> bool:
    """Trigger: the time-out truncated the frame before."""
    return event.previous_kind == "truncated"


def at_count(counter: str, number: int) -> Condition:
    """Return a trigger: so many came before; `counter` is `frames`, `faults` or `row` of Event."""
    return lambda event: bool(getattr(event, counter) == number)


def from_count(counter: str, number: int) -> Condition:
    """Return a trigger: at least so many came before; `counter` is a counter of Event."""
    return lambda event: bool(getattr(event, counter) >= number)


def every_nth(counter: str, number: int) -> Condition:
    """Return a trigger: each time that so many have come; `counter` is a counter of Event."""
    return lambda event: bool(getattr(event, counter) % number == number - 1)


def pipelined(event: Event) -> bool:
    """Trigger: the host did not wait for the answer before."""
    return event.pipelined


def split(event: Event) -> bool:
    """Trigger: the frame has a pause of more than 1 ms between two of its bytes."""
    return event.pause > MS


# -- effects on the answers ----------------------------------------------------------------------


def answers_with(*codes: int, delay: int = 0) -> React:
    """Return an effect: these codes are answered instead, `delay` ns late."""
    return lambda device, event, reaction: answers(reaction, *codes, delay=delay)


def answers_as(outcome: Outcome) -> React:
    """Return an effect: the code of that outcome is answered."""
    return lambda device, event, reaction: answers(reaction, device.protocol.answers[outcome].code)


answers_ok = answers_as(Outcome.VALID)
silent = answers_with()


def answers_as_before(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: the code due to the frame before is answered, if there was one."""
    if event.previous is None:
        return reaction
    return answers(reaction, event.previous.response.code)


def answers_again(milliseconds: int) -> React:
    """Return an effect: the code comes again that much later, unless another frame comes first."""
    return lambda device, event, reaction: replace(
        reaction, unasked=((milliseconds * MS, event.judgement.response.code),)
    )


def answers_twice(milliseconds: int) -> React:
    """Return an effect: the answers come, and once more that much later, whatever comes between."""
    return lambda device, event, reaction: replace(
        reaction,
        answers=(*reaction.answers, *((d + milliseconds * MS, c) for d, c in reaction.answers)),
    )


def twice(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: each answer is sent twice."""
    return replace(reaction, answers=reaction.answers * 2)


def late(milliseconds: float) -> React:
    """Return an effect: the answers come `milliseconds` later."""
    return lambda device, event, reaction: answers(
        reaction, *(code for _, code in reaction.answers), delay=int(milliseconds * MS)
    )


# -- effects on the state ------------------------------------------------------------------------


def drives_on(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: the state stays as it was before the frame."""
    return replace(reaction, state=event.before)


def starts_driving(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: a stopped robot drives forward."""
    if event.before.motion is not Motion.STOPPED:
        return reaction
    return replace(reaction, state=replace(reaction.state, motion=Motion.FORWARD))


def stands_still(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: the robot stops."""
    return replace(reaction, state=replace(reaction.state, motion=Motion.STOPPED))


def sets(**variables: object) -> React:
    """Return an effect: the state afterwards has these values."""
    return lambda device, event, reaction: replace(
        reaction, state=replace(reaction.state, **variables)  # type: ignore[arg-type]
    )  # fmt: skip


def becomes(change: Change) -> React:
    """Return an effect: `change` makes the state from the event and the correct state."""
    return lambda device, event, reaction: replace(reaction, state=change(event, reaction.state))


def resizes(variable: str, size: Callable[[int], int]) -> React:
    """Return an effect: `size` makes the variable's value from the correct one; the sign stays."""

    def change(event: Event, state: State) -> State:
        value = getattr(state, variable)
        resized: Any = -size(-value) if value < 0 else size(value)
        return replace(state, **{variable: resized})

    return becomes(change)


def sets_bit(variable: str, bit: int) -> React:
    """Return an effect: the bit of the variable is 1."""
    return resizes(variable, lambda size: size | 1 << bit)


def clears_bit(variable: str, bit: int) -> React:
    """Return an effect: the bit of the variable is 0."""
    return resizes(variable, lambda size: size & ~(1 << bit))


def shows_low_bits(high: int) -> React:
    """Return an effect: the LED shows those bits of the first field that `high` has."""
    return becomes(lambda e, state: replace(state, led=e.judgement.fields[0][1] & high))


def keeps(variable: str) -> React:
    """Return an effect: the variable stays as it was before the frame."""
    return lambda device, event, reaction: replace(
        reaction, state=replace(reaction.state, **{variable: getattr(event.before, variable)})
    )


def stops_after(milliseconds: float) -> React:
    """Return an effect: the state changes `milliseconds` later, if no frame comes before."""
    return lambda device, event, reaction: replace(
        reaction, state=event.before, later=((int(milliseconds * MS), reaction.state),)
    )


def resumes_after(milliseconds: float) -> React:
    """Return an effect: the state from before the frame returns `milliseconds` later."""
    return lambda device, event, reaction: replace(
        reaction, later=((int(milliseconds * MS), event.before),)
    )


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


# -- effects on both, and effects that remember --------------------------------------------------


def then(*changes: React) -> React:
    """Return an effect that makes the changes one after the other."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        for change in changes:
            reaction = change(device, event, reaction)
        return reaction

    return react


accepts = then(drives_on, answers_ok)
loses = then(drives_on, silent)


def as_if(device: MutatedDevice, event: Event, reaction: Reaction, frame: bytes) -> Reaction:
    """Return the reaction of a conforming device to another frame, `frame`."""
    judgement, state = device.step(frame, event.before)
    return replace(answers(reaction, judgement.response.code), state=state)


def latched(begins: Condition, change: React, ends: Condition = lambda event: False) -> React:
    """Return an effect: the change is made from a frame that begins it until one that ends it."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if ends(event):
            device.memory.pop("latched", None)
        elif begins(event):
            device.memory["latched"] = 1
        return change(device, event, reaction) if "latched" in device.memory else reaction

    return react


def restarts(condition: Condition, settings: int = 0) -> React:
    """Return an effect: the motion that the last fault ended resumes if the condition holds.

    `settings` is the number of valid frames since then at which it resumes; 0 for any. An
    instruction that sets the motion ends the wait.
    """

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        memory = device.memory
        if faulty(event) and event.before.moving:
            memory["motion"] = list(Motion).index(event.before.motion)
            memory["settings"] = 0
            return reaction
        instruction = event.judgement.instruction
        if valid(event) and instruction and instruction.effect.sets("motion"):
            memory.pop("motion", None)
        if "motion" not in memory:
            return reaction
        if valid(event):
            memory["settings"] = min(memory["settings"] + 1, settings + 1)
        if not condition(event) or (settings and memory["settings"] != settings):
            return reaction
        motion = list(Motion)[memory.pop("motion")]
        return replace(reaction, state=replace(reaction.state, motion=motion))

    return react
