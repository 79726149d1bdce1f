"""Building blocks of faults: triggers, effects, and globs of the cases that catch them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Event, MutatedDevice, React, Reaction, answers
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion, State
from bilprov.spec.protocol import InstructionSpec

Condition = Callable[[Event], bool]
Change = Callable[[Event, State], State]

# Cases other than single frames: sequences, delivery, soak, consistency of readings.
SEQUENCE = ("sequence/*",)
PIPELINED = ("pipelined/*",)
SPLIT = ("split/*",)
SOAK = ("pipelined/soak/*",)
READING = ("reading/*",)

EVERYTHING = ("*",)

# The cases of each outcome in which the stop and the state are observed.
WATCHED = {
    Outcome.UNKNOWN_ID: ("unused-id/*", "recovery/unused-id/*"),
    Outcome.BAD_DATA: ("bad-data/*", "recovery/bad-data/*"),
    Outcome.TOO_MANY: ("wrong-length/*", "recovery/too-many/*"),
    Outcome.TOO_FEW: ("wrong-length/*", "recovery/too-few/*"),
}
WATCHED_CUT = ("truncated/*", "recovery/truncated/*")
# Cases that hold the stop and send valid instructions after it: for faults that show later.
FOLLOWED = ("unused-id/*", "bad-data/*", "wrong-length/*", "truncated/*")
WATCHED_FAULTS = (*FOLLOWED, "recovery/*")

# The cases of each outcome in which its answer shows.
CASES = {
    **WATCHED,
    Outcome.UNKNOWN_ID: (*WATCHED[Outcome.UNKNOWN_ID], "link/unused-id"),
    Outcome.TOO_FEW: (*WATCHED[Outcome.TOO_FEW], "link/too-few"),
}
# The time-out is measured on a robot that moves, in the first kind of motion that it has.
TIMED = ("timing/truncation-timeout",)
CUT = (*WATCHED_CUT, *TIMED)
WHOLE_FAULTS = tuple(dict.fromkeys(glob for globs in CASES.values() for glob in globs))
ALL_FAULTY = (*WHOLE_FAULTS, *CUT)


def slug(outcome: Outcome) -> str:
    """Return an outcome as it is written in a fault's name: `too-few`."""
    return outcome.name.lower().replace("_", "-")


def when(matches: Callable[[Event], bool], change: React) -> React:
    """Return an effect that makes the change for the frames that match."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        return change(device, event, reaction) if matches(event) else reaction

    return react


def faults_only(change: React) -> React:
    """Return an effect that makes the change for faulty frames only."""
    return when(lambda event: not event.judgement.valid, change)


def is_outcome(outcome: Outcome) -> Callable[[Event], bool]:
    """Return a trigger: complete frames with that outcome."""
    return lambda event: event.judgement.outcome is outcome and not is_truncated(event)


def is_truncated(event: Event) -> bool:
    """Trigger: frames that the time-out truncated."""
    return event.kind == "truncated"


def is_named(spec: InstructionSpec) -> Callable[[Event], bool]:
    """Return a trigger: valid frames of that instruction."""
    return lambda event: event.judgement.valid and event.judgement.id == spec.id


def answers_with(*codes: int, delay: int = 0) -> React:
    """Return an effect: these codes are answered instead, `delay` ns late."""
    return lambda device, event, reaction: answers(reaction, *codes, delay=delay)


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


# -- triggers: conditions on a frame and its history -------------------------------------------


def every(*conditions: Condition) -> Condition:
    """Return a trigger: all of the conditions hold."""
    return lambda event: all(condition(event) for condition in conditions)


def faulty(event: Event) -> bool:
    """Trigger: any faulty frame."""
    return not event.judgement.valid


def valid(event: Event) -> bool:
    """Trigger: any valid frame."""
    return event.judgement.valid


def after(spec: InstructionSpec) -> Condition:
    """Return a trigger: the frame before was that instruction, and valid."""
    return lambda event: (
        event.previous is not None and event.previous.valid and event.previous.id == spec.id
    )


def after_a_fault(event: Event) -> bool:
    """Trigger: the frame before was faulty."""
    return event.row > 0


def moving_in(motion: Motion) -> Condition:
    """Return a trigger: the robot was in that motion when the frame came."""
    return lambda event: event.before.moving and event.before.motion is motion


def carries(spec: InstructionSpec, *values: int) -> Condition:
    """Return a trigger: valid frames of that instruction whose first field has such a value."""
    named = is_named(spec)
    return lambda event: named(event) and event.judgement.fields[0][1] in values


def pipelined(event: Event) -> bool:
    """Trigger: the host did not wait for the answer before."""
    return event.pipelined


def split(event: Event) -> bool:
    """Trigger: the frame has a pause of more than 1 ms between two of its bytes."""
    return event.pause > MS


# -- effects: changes of the reaction to a frame -------------------------------------------------


def sets(**variables: object) -> React:
    """Return an effect: the state afterwards has these values."""
    return lambda device, event, reaction: replace(
        reaction, state=replace(reaction.state, **variables)  # type: ignore[arg-type]
    )  # fmt: skip


def becomes(change: Change) -> React:
    """Return an effect: `change` makes the state from the event and the correct state."""
    return lambda device, event, reaction: replace(reaction, state=change(event, reaction.state))


def keeps(variable: str) -> React:
    """Return an effect: the variable stays as it was before the frame."""
    return lambda device, event, reaction: replace(
        reaction, state=replace(reaction.state, **{variable: getattr(event.before, variable)})
    )


def then(*changes: React) -> React:
    """Return an effect that makes the changes one after the other."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        for change in changes:
            reaction = change(device, event, reaction)
        return reaction

    return react


def twice(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: each answer is sent twice."""
    return replace(reaction, answers=reaction.answers * 2)


def late(milliseconds: float) -> React:
    """Return an effect: the answers come `milliseconds` later."""
    return lambda device, event, reaction: answers(
        reaction, *(code for _, code in reaction.answers), delay=int(milliseconds * MS)
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


def as_if(device: MutatedDevice, event: Event, reaction: Reaction, frame: bytes) -> Reaction:
    """Return the reaction of a conforming device to another frame, `frame`."""
    judgement, state = device.step(frame, event.before)
    return replace(answers(reaction, judgement.response.code), state=state)


# -- parts of a fault's name ---------------------------------------------------------------------


def words(motion: Motion) -> str:
    """Return a motion as it is written in a fault's name: `rotate-left`."""
    return motion.value.replace("_", "-")


def ordinal(number: int) -> str:
    """Return an ordinal number in digits: `1st`, `2nd`, `13th`."""
    last = "th" if 10 <= number % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{last}"
