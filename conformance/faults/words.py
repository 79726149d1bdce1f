"""The words that faults are made of: when they show, what they do, and which cases catch them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from conformance.simulator import Event, React, Reaction, Simulator, answers
from spec.fields import Outcome
from spec.motion import Motion
from spec.protocol import InstructionSpec

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
CUT = (*WATCHED_CUT, "timing/truncation-timeout")
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
