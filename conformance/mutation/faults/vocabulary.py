"""The words that faults are made of: when they show, what they do, and which cases catch them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from conformance.dut.simulator import MS, Event, React, Reaction, Simulator, answers
from spec.fields import Outcome
from spec.motion import Motion, State
from spec.protocol import InstructionSpec, Protocol

Condition = Callable[[Event], bool]
Change = Callable[[Event, State], State]

# The cases that single frames are not: sequences, delivery, history, consistency of readings.
SEQUENCE = ("sequence/*",)
PIPELINED = ("pipelined/*",)
SPLIT = ("split/*",)
HISTORY = ("history/*",)
READING = ("reading/*",)

EVERYTHING = ("*",)

# The cases of each outcome whose stop and state are watched.
WATCHED = {
    Outcome.UNKNOWN_ID: ("unused-id/*", "recovery/unused-id/*"),
    Outcome.BAD_DATA: ("bad-data/*", "recovery/bad-data/*"),
    Outcome.TOO_MANY: ("wrong-length/*", "recovery/too-many/*"),
    Outcome.TOO_FEW: ("wrong-length/*", "recovery/too-few/*"),
}
WATCHED_CUT = ("truncated/*", "recovery/truncated/*")
# Held and followed by valid instructions: what shows only some time after the stop.
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
    """The outcome in a fault's name."""
    return outcome.name.lower().replace("_", "-")


def when(matches: Callable[[Event], bool], change: React) -> React:
    """The change, for the frames that match."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        return change(device, event, reaction) if matches(event) else reaction

    return react


def faults_only(change: React) -> React:
    """The change, for faulty frames alone."""
    return when(lambda event: not event.judgement.valid, change)


def is_outcome(outcome: Outcome) -> Callable[[Event], bool]:
    """Whole frames of that outcome."""
    return lambda event: event.judgement.outcome is outcome and not is_truncated(event)


def is_truncated(event: Event) -> bool:
    """Frames that the time-out cut short."""
    return event.kind == "truncated"


def is_named(spec: InstructionSpec) -> Callable[[Event], bool]:
    """Valid frames of that instruction."""
    return lambda event: event.judgement.valid and event.judgement.id == spec.id


def answers_with(*codes: int, delay: int = 0) -> React:
    """Other answers, `delay` ns late."""
    return lambda device, event, reaction: answers(reaction, *codes, delay=delay)


def drives_on(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
    """The state stays as it was."""
    return replace(reaction, state=event.before)


def starts_driving(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
    """A stopped robot drives forward."""
    if event.before.motion is not Motion.STOPPED:
        return reaction
    return replace(reaction, state=replace(reaction.state, motion=Motion.FORWARD))


def stands_still(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
    """The robot stops."""
    return replace(reaction, state=replace(reaction.state, motion=Motion.STOPPED))


# -- what frames are: conditions ---------------------------------------------------------------


def every(*conditions: Condition) -> Condition:
    """All of the conditions hold."""
    return lambda event: all(condition(event) for condition in conditions)


def faulty(event: Event) -> bool:
    """Any faulty frame."""
    return not event.judgement.valid


def valid(event: Event) -> bool:
    """Any valid frame."""
    return event.judgement.valid


def after(spec: InstructionSpec) -> Condition:
    """The frame before was that instruction, without fault."""
    return lambda event: (
        event.previous is not None and event.previous.valid and event.previous.id == spec.id
    )


def after_a_fault(event: Event) -> bool:
    """The frame before was faulty."""
    return event.row > 0


def moving_in(motion: Motion) -> Condition:
    """The robot moved in that way when the frame came."""
    return lambda event: event.before.moving and event.before.motion is motion


def carries(spec: InstructionSpec, *values: int) -> Condition:
    """A valid frame of that instruction whose first field has one of the values."""
    named = is_named(spec)
    return lambda event: named(event) and event.judgement.fields[0][1] in values


def pipelined(event: Event) -> bool:
    """Sent without waiting for the answer before."""
    return event.pipelined


def split(event: Event) -> bool:
    """With a pause of more than a millisecond between two of its bytes."""
    return event.pause > MS


# -- what they then do: changes ------------------------------------------------------------------


def sets(**variables: object) -> React:
    """The state afterwards has these values."""
    return lambda device, event, reaction: replace(
        reaction, state=replace(reaction.state, **variables)  # type: ignore[arg-type]
    )  # fmt: skip


def becomes(change: Change) -> React:
    """The state afterwards, out of the event and the state that was right."""
    return lambda device, event, reaction: replace(reaction, state=change(event, reaction.state))


def keeps(variable: str) -> React:
    """The variable stays as it was before the frame."""
    return lambda device, event, reaction: replace(
        reaction, state=replace(reaction.state, **{variable: getattr(event.before, variable)})
    )


def then(*changes: React) -> React:
    """One change after the other."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        for change in changes:
            reaction = change(device, event, reaction)
        return reaction

    return react


def twice(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
    """Each answer comes two times."""
    return replace(reaction, answers=reaction.answers * 2)


def late(milliseconds: float) -> React:
    """The answer comes so much later."""
    return lambda device, event, reaction: answers(
        reaction, *(code for _, code in reaction.answers), delay=int(milliseconds * MS)
    )


def stops_after(milliseconds: float) -> React:
    """What the frame does to the state happens so much later."""
    return lambda device, event, reaction: replace(
        reaction, state=event.before, later=((int(milliseconds * MS), reaction.state),)
    )


def resumes_after(milliseconds: float) -> React:
    """The state before comes back after so long."""
    return lambda device, event, reaction: replace(
        reaction, later=((int(milliseconds * MS), event.before),)
    )


def as_if(device: Simulator, event: Event, reaction: Reaction, frame: bytes) -> Reaction:
    """The reaction that a conforming device has to another frame."""
    judgement, state = device.step(frame, event.before)
    return replace(answers(reaction, judgement.response.code), state=state)


# -- what there is in a protocol -----------------------------------------------------------------


def setters(protocol: Protocol) -> tuple[InstructionSpec, ...]:
    """The instructions whose data set a variable and that leave the motion alone."""
    return tuple(
        s for s in protocol.instructions
        if s.fields and s.effect.assignments and not s.effect.sets("motion")
    )  # fmt: skip


def movers(protocol: Protocol) -> tuple[InstructionSpec, ...]:
    """The instructions without data that set it moving."""
    return tuple(
        s for s in protocol.instructions
        if not s.fields and s.effect.motion not in (None, Motion.STOPPED)
    )  # fmt: skip


def variable_of(spec: InstructionSpec) -> str:
    """The variable that a setter sets."""
    return spec.effect.assignments[0][0]


def words(motion: Motion) -> str:
    """A kind of motion in a fault's name: `rotate-left`."""
    return motion.value.replace("_", "-")


def ordinal(number: int) -> str:
    """`1st`, `2nd`, `13th`."""
    last = "th" if 10 <= number % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{last}"
