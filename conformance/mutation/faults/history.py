"""Faults triggered by history: the frames since power-on, the frame before, counts, latches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.family import (
    EVERYTHING,
    POWER_ON,
    SOAK,
    WATCHED_FAULTS,
    Family,
    ordinal,
)
from bilprov.conformance.mutation.faults.vocabulary import (
    Condition,
    accepts,
    after,
    after_a_fault,
    answers_as_before,
    answers_ok,
    at_count,
    becomes,
    drives_on,
    every,
    every_nth,
    faulty,
    from_count,
    is_named,
    is_outcome,
    is_truncated,
    latched,
    moving,
    restarts,
    sets,
    silent,
    stands_still,
    twice,
    valid,
    when,
)
from bilprov.spec.by_effect import movers, setters, variable_of
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import WHEELS, Motion, State
from bilprov.spec.protocol import InstructionSpec, Protocol

power_on_fault = Family("power-on", "responses instructions", POWER_ON)
history_fault = Family("history", "safety responses instructions", WATCHED_FAULTS)
pair_fault = Family("pair", "instructions")
fault_pair_fault = Family("pair", "safety")
count_fault = Family("history", "instructions")
soak_fault = Family("history", "instructions", SOAK)

_PAIRS = 10
_WRAP, _LONG_WRAP = 1 << 8, 1 << 16


def power_on_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that show at power-on, or in the first frames after it."""
    fast = protocol.limits.get("speed", (0, 1))[1]
    lost = ("power-on/lost",)
    turning = [s.effect.motion for s in protocol.instructions if s.effect.motion and not s.fields]
    for motion in turning[-1:]:
        yield power_on_fault(
            "turns-at-power-on",
            f"moves {motion.value} as soon as it is switched on",
            clauses="safety instructions",
            power_on=State(motion=motion, speed=fast // 2),
        )
        yield power_on_fault(
            "motion-set-at-power-on",
            f"begins to move {motion.value} with the first speed: a motion is set at power-on",
            clauses="safety instructions",
            power_on=State(motion=motion),
        )
    yield power_on_fault(
        "first-frame-answered-twice",
        "answers the first frame after power-on twice",
        when(at_count("frames", 0), twice),
    )
    yield power_on_fault(
        "second-frame-unanswered",
        "does not answer the second frame after power-on",
        when(at_count("frames", 1), silent),
        caught_by=lost,
    )
    yield power_on_fault(
        "first-fault-unanswered",
        "does not answer the first fault after power-on",
        when(every(faulty, at_count("faults", 0)), silent),
        caught_by=lost,
    )
    yield power_on_fault(
        "banner-after-first-frame",
        "introduces itself 5 ms after it has answered the first frame",
        when(
            at_count("frames", 0),
            lambda d, e, r: replace(r, answers=(*r.answers, *((5 * MS, c) for c in b"READY"))),
        ),
    )


def history_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that show in single frames after a number of faults."""
    for count in (10, 100):
        yield history_fault(
            f"no-stop-after-{count}-faults",
            f"after {count} faults it no longer stops for one",
            when(every(faulty, from_count("faults", count)), drives_on),
        )
    yield history_fault(
        "sticks-after-50-faults",
        "after 50 faults it answers nothing any more",
        when(from_count("faults", 50), silent),
        caught_by=EVERYTHING,
    )
    yield history_fault(
        "every-7th-fault-missed",
        "drives on after every seventh fault",
        when(every(faulty, every_nth("faults", 7)), drives_on),
    )


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
        yield fault_pair_fault(
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
            when(every(is_named(other), _moves_by(one)), drives_on),
        )
    turning = [s for s in moves if s.effect.motion and _turns(s.effect.motion)]
    straight = [s for s in moves if s not in turning]
    for mover in straight[:1]:
        yield pair_fault(
            f"{mover.name}-mirrors-steering-after-a-rotation",
            f"{mover.name} during a rotation takes the steering to the other side",
            when(
                every(is_named(mover), lambda e: _turns(e.before.motion)),
                becomes(lambda e, state: replace(state, steering=-state.steering)),
            ),
        )
    if turning:
        yield fault_pair_fault(
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
        yield fault_pair_fault(
            f"restarts-on-{setter.name}-after-a-fault",
            f"{setter.name} right after the fault that stopped it makes it drive on as before",
            restarts(every(is_named(setter), after_a_fault)),
            clauses="safety instructions responses",
        )
    yield fault_pair_fault(
        "restarts-on-second-setting-after-a-fault",
        "the second setting after the fault that stopped it makes it drive on as before",
        restarts(every(valid, at_count("row", 0)), settings=2),
    )
    yield fault_pair_fault(
        "restarts-on-second-fault",
        "a second fault in a row makes it drive on as before the first",
        restarts(every(faulty, at_count("row", 1))),
    )
    yield fault_pair_fault(
        "ok-to-second-fault",
        f"the second fault in a row is answered {protocol.answers[Outcome.VALID].name}",
        when(every(faulty, at_count("row", 1)), answers_ok),
        clauses="responses instructions",
    )
    yield fault_pair_fault(
        "silent-on-third-fault",
        "the third fault in a row is not answered",
        when(every(faulty, at_count("row", 2)), silent),
        clauses="responses instructions",
    )
    yield fault_pair_fault(
        "no-stop-at-the-fault-after-a-truncation",
        "after a frame that was cut short the next fault does not stop it",
        _no_stop_next_after_truncation,
    )
    yield fault_pair_fault(
        "stays-dead-after-two-faults",
        f"after two faults in a row it never moves again until {protocol.stop.name} comes",
        latched(every(faulty, from_count("row", 1)), stands_still, ends=is_named(protocol.stop)),
        clauses="instructions safety",
    )
    yield fault_pair_fault(
        "speed-lost-by-two-faults",
        "the second fault in a row zeroes the speed, the first does not",
        when(every(faulty, at_count("row", 1)), sets(speed=0)),
        clauses="safety instructions",
    )
    yield fault_pair_fault(
        "answer-sticks-after-two-faults",
        "the valid instruction after two faults is answered as if it were the third",
        when(every(valid, from_count("row", 2)), answers_as_before),
        clauses="responses instructions",
    )


def count_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that a count of frames or faults, or a latched event, triggers."""
    yield from _after_so_many(protocol)
    yield from _every_so_often()
    yield from _latched(protocol)
    yield from _only_a_soak()


def _after_so_many(protocol: Protocol) -> Iterator[Fault]:
    for count in (50, 200, 290):
        yield count_fault(
            f"no-stop-after-{count}-faults",
            f"after {count} faults it no longer stops for one",
            when(every(faulty, from_count("faults", count)), drives_on),
            clauses="safety",
        )
    for count in (5, 20):
        yield count_fault(
            f"silent-after-{count}-faults-in-a-row",
            f"after {count} faults without a valid instruction between it answers none more",
            when(every(faulty, from_count("row", count)), silent),
            clauses="responses instructions",
        )
    for count, setter in zip((100, 200, 300, 255), setters(protocol), strict=False):
        yield count_fault(
            f"{setter.name}-sticks-after-{count}-frames",
            f"after {count} frames {setter.name} is answered and no longer carried out",
            when(every(is_named(setter), from_count("frames", count)), drives_on),
        )
    for count, mover in zip((60, 256), movers(protocol), strict=False):
        yield count_fault(
            f"{mover.name}-dead-after-{count}-frames",
            f"after {count} frames {mover.name} is answered and does not move it",
            when(every(is_named(mover), from_count("frames", count)), drives_on),
        )


def _every_so_often() -> Iterator[Fault]:
    for count in (10, 100, _WRAP):
        yield count_fault(
            f"every-{ordinal(count)}-frame-unanswered",
            f"carries out every {ordinal(count)} frame and does not answer it",
            when(every_nth("frames", count), silent),
            clauses="responses instructions",
        )
    yield count_fault(
        "every-50th-frame-answered-twice",
        "answers every 50th frame twice",
        when(every_nth("frames", 50), twice),
        clauses="responses instructions",
    )
    yield count_fault(
        "every-13th-instruction-ignored",
        "answers every 13th frame and does not carry it out, if it is valid",
        when(every(valid, every_nth("frames", 13)), drives_on),
    )
    for count in (16, 100, _WRAP):
        yield count_fault(
            f"every-{ordinal(count)}-fault-missed",
            f"drives on after every {ordinal(count)} fault",
            when(every(faulty, every_nth("faults", count)), drives_on),
            clauses="safety instructions",
        )
    yield count_fault(
        "every-5th-cut-missed",
        "drives on after every fifth frame that is cut short",
        when(every(is_truncated, every_nth("truncated", 5)), drives_on),
        clauses="safety responses instructions",
    )
    yield count_fault(
        "each-fault-slows-it",
        "every tenth fault takes one step off the speed",
        when(
            every(faulty, every_nth("faults", 10)),
            becomes(lambda e, state: replace(state, speed=max(0, state.speed - 1))),
        ),
        clauses="safety instructions",
    )


def _latched(protocol: Protocol) -> Iterator[Fault]:
    yield count_fault(
        "first-fault-missed",
        "the first fault after power-on that finds it moving does not stop it",
        when(every(faulty, moving), _first_time_drives_on),
        clauses="safety instructions",
        caught_by=("power-on/first-fault",),
    )
    yield count_fault(
        "bad-data-fine-once-too-many-came",
        "once too many data bytes came, bad data is answered OK and does not stop it for ever",
        latched(is_outcome(Outcome.TOO_MANY), when(is_outcome(Outcome.BAD_DATA), accepts)),
        clauses="safety instructions responses",
    )
    yield count_fault(
        "stuck-forward-after-10-reversals",
        "after ten changes of motion while it moves, each motion is the first one",
        _worn_reverser(10),
    )
    yield count_fault(
        "ok-for-ever-after-20-bad-data",
        "after twenty bad data it answers OK to all of them",
        _after_outcomes(Outcome.BAD_DATA, 20, answers_ok),
        clauses="responses instructions",
    )
    for setter in setters(protocol)[-1:]:
        yield count_fault(
            f"{setter.name}-latches",
            f"{setter.name} at its highest value can never be changed again until power-off",
            _latching(variable_of(setter), setter.fields[0].high),
        )


def _only_a_soak() -> Iterator[Fault]:
    yield soak_fault(
        f"no-stop-after-{_LONG_WRAP}-frames",
        f"after {_LONG_WRAP} frames no fault stops it",
        when(every(faulty, from_count("frames", _LONG_WRAP)), drives_on),
        clauses="safety",
        needs="soak",
    )
    yield soak_fault(
        f"silent-after-{_LONG_WRAP}-frames",
        f"after {_LONG_WRAP} frames it answers nothing any more",
        when(from_count("frames", _LONG_WRAP), silent),
        clauses="responses instructions",
        needs="soak",
    )
    yield soak_fault(
        "dark-after-40000-frames",
        "after 40,000 frames its light goes out and stays out",
        when(from_count("frames", 40_000), sets(led=0)),
        needs="soak",
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


def _turns(motion: Motion) -> bool:
    left, right = WHEELS[motion]
    return left != right


def _rotating(event: Event) -> bool:
    """Trigger: the robot rotated when the frame came."""
    return event.before.moving and _turns(event.before.motion)


def _moves_by(spec: InstructionSpec) -> Condition:
    return lambda event: event.before.moving and event.before.motion is spec.effect.motion


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


def _first_time_drives_on(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    if "seen" in device.memory:
        return reaction
    device.memory["seen"] = 1
    return drives_on(device, event, reaction)


def _worn_reverser(changes: int) -> React:
    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if event.before.moving and reaction.state.moving:
            changed = event.before.motion is not reaction.state.motion
            count = min(device.memory.get("changes", 0) + changed, changes)
            device.memory["changes"] = count
        if device.memory.get("changes", 0) == changes and reaction.state.moving:
            return replace(reaction, state=replace(reaction.state, motion=Motion.FORWARD))
        return reaction

    return react


def _after_outcomes(outcome: Outcome, count: int, change: React) -> React:
    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if event.judgement.outcome is not outcome:
            return reaction
        seen = device.memory["seen"] = min(device.memory.get("seen", 0) + 1, count + 1)
        return change(device, event, reaction) if seen > count else reaction

    return react


def _latching(variable: str, high: int) -> React:
    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if getattr(event.before, variable) == high:
            return sets(**{variable: high})(device, event, reaction)
        return reaction

    return react
