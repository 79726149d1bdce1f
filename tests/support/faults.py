"""Building blocks of hand-made faults: conditions and effects of the bank's words, combined."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from bilprov.conformance.dut.simulator import Event, Fault, React, Reaction, Simulator
from bilprov.conformance.mutation.effects import does_effect, then
from bilprov.conformance.mutation.faults import Row, fault_bank, hooks
from bilprov.conformance.mutation.triggers import OUTCOME_WORDS, trigger
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.state import State
from tests.support import ROOT

Condition = Callable[[Event], bool]

accepts = does_effect("accepts")
drives_on = does_effect("drives-on")
silent = does_effect("silent")
stands_still = does_effect("stands-still")
twice = does_effect("twice")
answers_with = partial(does_effect, "answers-with")
keeps = partial(does_effect, "keeps")
late = partial(does_effect, "late")
resumes_after = partial(does_effect, "resumes-after")
watchdog = partial(does_effect, "watchdog")


def condition(text: str) -> Condition:
    """A trigger without memory as a function of the frame."""
    found = trigger(text)
    return lambda event: found.holds(event, {})


faulty = condition("faulty")
valid = condition("valid")


def is_outcome(outcome: Outcome) -> Condition:
    """Complete frames with that outcome."""
    return condition(f"outcome {OUTCOME_WORDS[outcome]}")


def at_count(counter: str, number: int) -> Condition:
    """So many came before."""
    return condition(f"{counter} {number}")


def every(*conditions: Condition) -> Condition:
    """All of the conditions hold."""
    return lambda event: all(one(event) for one in conditions)


def reacting(react: React, **more: Any) -> Fault:
    """A device that reacts so."""
    return Fault("x", "test", "", react=react, **more)


def when(matches: Condition, change: React) -> React:
    """The change, at the frames that match."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        return change(device, event, reaction) if matches(event) else reaction

    return react


def sets(**variables: object) -> React:
    """The state afterwards has these values."""
    return then(*(does_effect("sets", name, value) for name, value in variables.items()))


def becomes(change: Callable[[Event, State], State]) -> React:
    """The state is made from the event and the correct state."""
    return lambda device, event, reaction: replace(reaction, state=change(event, reaction.state))


def made(protocol: Protocol, what: str, when: str = "") -> Fault:
    """The fault of these words."""
    return Fault("x", "test", "", **hooks(protocol, Row("", what, when)))


OWN = load((ROOT / "spec" / "grammar.py").read_text(encoding="utf-8"), "grammar.py")
BANK = fault_bank(OWN)
"""The faults of the kit's own grammar: xdist must collect the same tests everywhere."""

EIGHT_BITS = Fault(
    *("eight-bits", "test", "keeps its steering in eight bits"),
    react=becomes(lambda _, state: state.but(steering=(state.steering + 128) % 256 - 128)),
)
