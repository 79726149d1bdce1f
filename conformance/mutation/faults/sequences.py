"""Faults triggered by a sequence of frames: after a certain instruction, or after faults."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.family import Family
from bilprov.conformance.mutation.faults.vocabulary import (
    after,
    after_a_fault,
    answers_as_before,
    answers_ok,
    at_count,
    becomes,
    drives_on,
    every,
    faulty,
    from_count,
    is_named,
    is_truncated,
    latched,
    moving_in,
    restarts,
    sets,
    silent,
    stands_still,
    valid,
    when,
)
from bilprov.spec.by_effect import movers, setters, variable_of
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import WHEELS, State, rotates
from bilprov.spec.protocol import InstructionSpec, Protocol

pair_fault = Family("pair", "instructions")
stop_pair_fault = Family("pair", "safety")
answer_pair_fault = Family("pair", "responses instructions")

_PAIRS = 10


def pair_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that show only after a certain instruction or fault."""
    yield from _after_an_instruction(protocol)
    yield from _the_same_again(protocol)
    yield from _after_faults(protocol)


def _after_an_instruction(protocol: Protocol) -> Iterator[Fault]:
    settings, moves = setters(protocol), movers(protocol)
    for one, other in _some_pairs(protocol):
        yield pair_fault(
            f"{other.name}-ignored-after-{one.name}",
            f"{other.name} right after {one.name} is answered and not carried out",
            when(every(is_named(other), after(one)), drives_on),
            # Homing ends with stops, so a set-up cannot make this setting: it shows after faults.
            clauses="instructions safety" if one is protocol.stop else "instructions",
        )
    for setter in settings:
        yield stop_pair_fault(
            f"no-stop-after-{setter.name}",
            f"a fault right after {setter.name} does not stop it",
            when(every(faulty, after(setter)), drives_on),
        )
    for setter, mover in zip(settings, reversed(moves), strict=False):
        yield pair_fault(
            f"{setter.name}-stops-it-after-{mover.name}",
            f"{setter.name} right after {mover.name} stops it",
            when(every(is_named(setter), after(mover)), stands_still),
        )
    for one, other in _opposite(moves):
        yield pair_fault(
            f"{other.name}-ignored-while-{one.name}",
            f"{other.name} does nothing as long as it moves by {one.name}: it wants a stop between",
            when(every(is_named(other), moving_in(one.effect.motion)), drives_on),
        )
    turning = [s for s in moves if s.effect.motion and rotates(s.effect.motion)]
    straight = [s for s in moves if s not in turning]
    for mover in straight[:1]:
        yield pair_fault(
            f"{mover.name}-mirrors-steering-after-a-rotation",
            f"{mover.name} during a rotation takes the steering to the other side",
            when(
                every(is_named(mover), lambda e: rotates(e.before.motion)),
                becomes(lambda e, state: replace(state, steering=-state.steering)),
            ),
        )
    if turning:
        yield stop_pair_fault(
            "no-stop-once-it-has-rotated",
            f"once it has rotated no fault stops it until {protocol.stop.name} comes",
            latched(_rotating, when(faulty, drives_on), ends=is_named(protocol.stop)),
        )
    steers = [s for s in settings if variable_of(s) == "steering"]
    for one, other in zip(steers, reversed(steers), strict=True):
        if one is not other:
            yield pair_fault(
                f"{other.name}-adds-to-{one.name}",
                f"{other.name} right after {one.name} is added to it instead of replacing it",
                when(every(is_named(other), after(one)), _adds(protocol.limits["steering"])),
            )


def _the_same_again(protocol: Protocol) -> Iterator[Fault]:
    for mover in movers(protocol):
        yield pair_fault(
            f"{mover.name}-again-stops-it",
            f"a second {mover.name} in a row stops it, as if it were a switch",
            when(every(is_named(mover), after(mover)), stands_still),
        )
    for setter in setters(protocol):
        yield pair_fault(
            f"{setter.name}-again-ignored",
            f"the second {setter.name} in a row is answered and ignored",
            when(every(is_named(setter), after(setter)), drives_on),
        )


def _after_faults(protocol: Protocol) -> Iterator[Fault]:
    for setter in setters(protocol):
        yield stop_pair_fault(
            f"restarts-on-{setter.name}-after-a-fault",
            f"{setter.name} right after the fault that stopped it makes it drive on as before",
            restarts(every(is_named(setter), after_a_fault)),
            clauses="safety instructions responses",
        )
    yield stop_pair_fault(
        "restarts-on-second-setting-after-a-fault",
        "the second setting after the fault that stopped it makes it drive on as before",
        restarts(every(valid, at_count("row", 0)), settings=2),
    )
    yield stop_pair_fault(
        "restarts-on-second-fault",
        "a second fault in a row makes it drive on as before the first",
        restarts(every(faulty, at_count("row", 1))),
    )
    yield answer_pair_fault(
        "ok-to-second-fault",
        f"the second fault in a row is answered {protocol.answers[Outcome.VALID].name}",
        when(every(faulty, at_count("row", 1)), answers_ok),
    )
    yield answer_pair_fault(
        "silent-on-third-fault",
        "the third fault in a row is not answered",
        when(every(faulty, at_count("row", 2)), silent),
    )
    yield stop_pair_fault(
        "no-stop-at-the-fault-after-a-truncation",
        "after a frame that was cut short the next fault does not stop it",
        _no_stop_next_after_truncation,
    )
    yield stop_pair_fault(
        "stays-dead-after-two-faults",
        f"after two faults in a row it never moves again until {protocol.stop.name} comes",
        latched(every(faulty, from_count("row", 1)), stands_still, ends=is_named(protocol.stop)),
        clauses="instructions safety",
    )
    yield stop_pair_fault(
        "speed-lost-by-two-faults",
        "the second fault in a row zeroes the speed, the first does not",
        when(every(faulty, at_count("row", 1)), sets(speed=0)),
        clauses="safety instructions",
    )
    yield answer_pair_fault(
        "answer-sticks-after-two-faults",
        "the valid instruction after two faults is answered as if it were the third",
        when(every(valid, from_count("row", 2)), answers_as_before),
    )


def _some_pairs(protocol: Protocol) -> list[tuple[InstructionSpec, InstructionSpec]]:
    """Return some pairs of instructions, spread over all; one is a setting after the stop."""
    acting = [s for s in protocol.instructions if s.effect.assignments and s is not protocol.stop]
    stop = protocol.stop
    first = [(stop, s) for s in setters(protocol)[:1]] + [(s, stop) for s in acting[-1:]]
    pairs = [(one, other) for one in acting for other in acting if one is not other]
    return first + pairs[:: max(1, len(pairs) // (_PAIRS - len(first)))]


def _opposite(
    moves: tuple[InstructionSpec, ...],
) -> Iterator[tuple[InstructionSpec, InstructionSpec]]:
    """Yield the pairs of motion instructions whose wheels turn in opposite directions."""
    for one in moves:
        for other in moves:
            ways = [WHEELS[s.effect.motion] for s in (one, other) if s.effect.motion]
            if ways[0] == tuple(-side for side in ways[1]):
                yield one, other


def _rotating(event: Event) -> bool:
    """Trigger: the robot rotated when the frame came."""
    return event.before.moving and rotates(event.before.motion)


def _adds(limits: tuple[int, int]) -> React:
    """Return an effect: the steering is added to the steering before, within the limits."""
    low, high = limits

    def added(event: Event, state: State) -> State:
        return replace(state, steering=min(max(state.steering + event.before.steering, low), high))

    return becomes(added)


def _no_stop_next_after_truncation(
    device: MutatedDevice, event: Event, reaction: Reaction
) -> Reaction:
    if is_truncated(event):
        device.memory["cut"] = 1
    elif faulty(event) and device.memory.pop("cut", 0):
        return replace(reaction, state=event.before)
    return reaction
