"""Faults that show only after a certain earlier instruction or fault."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.vocabulary import (
    SEQUENCE,
    Change,
    Condition,
    after,
    after_a_fault,
    answers_with,
    becomes,
    drives_on,
    every,
    faulty,
    is_named,
    is_truncated,
    stands_still,
    valid,
    when,
)
from bilprov.spec.by_effect import movers, setters, variable_of
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import WHEELS, Motion, State
from bilprov.spec.protocol import InstructionSpec, Protocol

_FAMILY = "pair"
_PAIRS = 10


def pair_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that show only after a certain instruction or fault."""
    yield from _after_an_instruction(protocol)
    yield from _the_same_again(protocol)
    yield from _after_faults(protocol)


def _after_an_instruction(protocol: Protocol) -> Iterator[Fault]:
    settings, moving = setters(protocol), movers(protocol)
    for one, other in _some_pairs(protocol):
        yield _fault(
            f"{other.name}-ignored-after-{one.name}",
            f"{other.name} right after {one.name} is answered and not carried out",
            when(every(is_named(other), after(one)), drives_on),
            # Homing ends with stops, so a set-up cannot make this setting: it shows after faults.
            *(("instructions", "safety") if one is protocol.stop else ("instructions",)),
        )
    for setter in settings:
        yield _fault(
            f"no-stop-after-{setter.name}",
            f"a fault right after {setter.name} does not stop it",
            when(every(faulty, after(setter)), drives_on),
            "safety",
        )
    for setter, mover in zip(settings, reversed(moving), strict=False):
        yield _fault(
            f"{setter.name}-stops-it-after-{mover.name}",
            f"{setter.name} right after {mover.name} stops it",
            when(every(is_named(setter), after(mover)), stands_still),
            "instructions",
        )
    for one, other in _opposite(moving):
        yield _fault(
            f"{other.name}-ignored-while-{one.name}",
            f"{other.name} does nothing as long as it moves by {one.name}: it wants a stop between",
            when(every(is_named(other), _moves_by(one)), drives_on),
            "instructions",
        )
    turning = [s for s in moving if s.effect.motion and _turns(s.effect.motion)]
    straight = [s for s in moving if s not in turning]
    for mover in straight[:1]:
        yield _fault(
            f"{mover.name}-mirrors-steering-after-a-rotation",
            f"{mover.name} during a rotation takes the steering to the other side",
            when(
                every(is_named(mover), lambda e: _turns(e.before.motion)),
                becomes(lambda e, state: replace(state, steering=-state.steering)),
            ),
            "instructions",
        )
    if turning:
        yield _fault(
            "no-stop-once-it-has-rotated",
            f"once it has rotated no fault stops it until {protocol.stop.name} comes",
            _no_stop_once_rotated,
            "safety",
        )
    steers = [s for s in settings if variable_of(s) == "steering"]
    for one, other in zip(steers, reversed(steers), strict=True):
        if one is not other:
            yield _fault(
                f"{other.name}-adds-to-{one.name}",
                f"{other.name} right after {one.name} is added to it instead of replacing it",
                when(
                    every(is_named(other), after(one)), becomes(_added(protocol.limits["steering"]))
                ),
                "instructions",
            )


def _the_same_again(protocol: Protocol) -> Iterator[Fault]:
    for mover in movers(protocol):
        yield _fault(
            f"{mover.name}-again-stops-it",
            f"a second {mover.name} in a row stops it, as if it were a switch",
            when(every(is_named(mover), after(mover)), stands_still),
            "instructions",
        )
    for setter in setters(protocol):
        yield _fault(
            f"{setter.name}-again-ignored",
            f"the second {setter.name} in a row is answered and ignored",
            when(every(is_named(setter), after(setter)), drives_on),
            "instructions",
        )


def _after_faults(protocol: Protocol) -> Iterator[Fault]:
    ok = protocol.answers[Outcome.VALID].code
    for setter in setters(protocol):
        yield _fault(
            f"restarts-on-{setter.name}-after-a-fault",
            f"{setter.name} right after the fault that stopped it makes it drive on as before",
            _restart_when(every(is_named(setter), after_a_fault)),
            *("safety", "instructions", "responses"),
        )
    yield _fault(
        "restarts-on-second-setting-after-a-fault",
        "the second setting after the fault that stopped it makes it drive on as before",
        _restart_when(lambda e: valid(e) and e.row == 0, settings=2),
        "safety",
    )
    yield _fault(
        "restarts-on-second-fault",
        "a second fault in a row makes it drive on as before the first",
        _restart_when(lambda e: faulty(e) and e.row == 1),
        "safety",
    )
    yield _fault(
        "ok-to-second-fault",
        f"the second fault in a row is answered {protocol.answers[Outcome.VALID].name}",
        when(lambda e: faulty(e) and e.row == 1, answers_with(ok)),
        "responses",
        "instructions",
    )
    yield _fault(
        "silent-on-third-fault",
        "the third fault in a row is not answered",
        when(lambda e: faulty(e) and e.row == 2, answers_with()),
        "responses",
        "instructions",
    )
    yield _fault(
        "no-stop-at-the-fault-after-a-truncation",
        "after a frame that was cut short the next fault does not stop it",
        _no_stop_next_after_truncation,
        "safety",
    )
    yield _fault(
        "stays-dead-after-two-faults",
        f"after two faults in a row it never moves again until {protocol.stop.name} comes",
        _dead_after(2),
        "instructions",
        "safety",
    )
    yield _fault(
        "speed-lost-by-two-faults",
        "the second fault in a row zeroes the speed, the first does not",
        when(lambda e: faulty(e) and e.row == 1, becomes(lambda e, s: replace(s, speed=0))),
        "safety",
        "instructions",
    )
    yield _fault(
        "answer-sticks-after-two-faults",
        "the valid instruction after two faults is answered as if it were the third",
        when(
            lambda e: valid(e) and e.row >= 2,
            lambda d, e, r: (
                answers_with(e.previous.response.code)(d, e, r) if e.previous is not None else r
            ),
        ),
        "responses",
        "instructions",
    )


def _fault(name: str, doc: str, react: React, *clauses: str) -> Fault:
    return Fault(name.lower(), _FAMILY, doc, SEQUENCE, react=react, clauses=clauses)


def _some_pairs(protocol: Protocol) -> list[tuple[InstructionSpec, InstructionSpec]]:
    """Return some pairs of instructions, spread over all; one is a setting after the stop."""
    acting = [s for s in protocol.instructions if s.effect.assignments and s is not protocol.stop]
    stop = protocol.stop
    first = [(stop, s) for s in setters(protocol)[:1]] + [(s, stop) for s in acting[-1:]]
    pairs = [(one, other) for one in acting for other in acting if one is not other]
    return first + pairs[:: max(1, len(pairs) // (_PAIRS - len(first)))]


def _opposite(
    moving: tuple[InstructionSpec, ...],
) -> Iterator[tuple[InstructionSpec, InstructionSpec]]:
    """Yield the pairs of motion instructions whose wheels turn in opposite directions."""
    for one in moving:
        for other in moving:
            ways = [WHEELS[s.effect.motion] for s in (one, other) if s.effect.motion]
            if ways[0] == tuple(-side for side in ways[1]):
                yield one, other


def _turns(motion: Motion) -> bool:
    left, right = WHEELS[motion]
    return left != right


def _moves_by(spec: InstructionSpec) -> Condition:
    return lambda event: event.before.moving and event.before.motion is spec.effect.motion


def _added(limits: tuple[int, int]) -> Change:
    low, high = limits

    def added(event: Event, state: State) -> State:
        return replace(state, steering=min(max(state.steering + event.before.steering, low), high))

    return added


def _no_stop_once_rotated(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    if event.judgement.valid:
        if event.judgement.valid and event.judgement.id == device.protocol.stop.id:
            device.memory.pop("rotated", None)
        elif reaction.state.moving and _turns(reaction.state.motion):
            device.memory["rotated"] = 1
    elif "rotated" in device.memory:
        return replace(reaction, state=event.before)
    return reaction


def _no_stop_next_after_truncation(
    device: MutatedDevice, event: Event, reaction: Reaction
) -> Reaction:
    if is_truncated(event):
        device.memory["cut"] = 1
    elif faulty(event) and device.memory.pop("cut", 0):
        return replace(reaction, state=event.before)
    return reaction


def _dead_after(faults: int) -> React:
    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if faulty(event) and event.row + 1 >= faults:
            device.memory["dead"] = 1
        elif event.judgement.valid and event.judgement.id == device.protocol.stop.id:
            device.memory.pop("dead", None)
        return stands_still(device, event, reaction) if "dead" in device.memory else reaction

    return react


def _restart_when(condition: Condition, settings: int = 0) -> React:
    """Return an effect: the motion that the last fault ended resumes if the condition holds.

    `settings` is the number of valid frames since then at which it resumes; 0 for any.
    """

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if faulty(event) and event.before.moving:
            device.memory["motion"] = list(Motion).index(event.before.motion)
            device.memory["settings"] = 0
            return reaction
        instruction = event.judgement.instruction
        if valid(event) and instruction and instruction.effect.sets("motion"):
            device.memory.pop("motion", None)
        if "motion" not in device.memory:
            return reaction
        if valid(event):
            device.memory["settings"] = min(device.memory["settings"] + 1, settings + 1)
        if not condition(event) or (settings and device.memory["settings"] != settings):
            return reaction
        motion = list(Motion)[device.memory.pop("motion")]
        return replace(reaction, state=replace(reaction.state, motion=motion))

    return react
