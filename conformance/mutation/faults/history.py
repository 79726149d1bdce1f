"""Faults triggered by history: power-on, counts of frames or faults, and latched events."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.captures.text import ordinal
from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.family import (
    EVERYTHING,
    MANY_FRAMES,
    POWER_ON,
    WATCHED_FAULTS,
    Family,
)
from bilprov.conformance.mutation.faults.vocabulary import (
    accepts,
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
    keeps,
    latched,
    moving,
    sets,
    silent,
    twice,
    valid,
    when,
)
from bilprov.spec.by_effect import movers, setters, variable_of
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion, State
from bilprov.spec.protocol import Protocol

power_on_fault = Family("power-on", "responses instructions", POWER_ON)
history_fault = Family("history", "safety responses instructions", WATCHED_FAULTS)
count_fault = Family("history", "instructions")
stop_count_fault = Family("history", "safety instructions")
answer_count_fault = Family("history", "responses instructions")
after_many = Family("history", "instructions", MANY_FRAMES)

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


def count_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that a count of frames or faults, or a latched event, triggers."""
    yield from _after_so_many(protocol)
    yield from _every_so_often()
    yield from _after_an_event(protocol)
    yield from _after_many_frames()


def _after_so_many(protocol: Protocol) -> Iterator[Fault]:
    for count in (50, 200, 290):
        yield count_fault(
            f"no-stop-after-{count}-faults",
            f"after {count} faults it no longer stops for one",
            when(every(faulty, from_count("faults", count)), drives_on),
            clauses="safety",
        )
    for count in (5, 20):
        yield answer_count_fault(
            f"silent-after-{count}-faults-in-a-row",
            f"after {count} faults without a valid instruction between it answers none more",
            when(every(faulty, from_count("row", count)), silent),
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
        yield answer_count_fault(
            f"every-{ordinal(count)}-frame-unanswered",
            f"carries out every {ordinal(count)} frame and does not answer it",
            when(every_nth("frames", count), silent),
        )
    yield answer_count_fault(
        "every-50th-frame-answered-twice",
        "answers every 50th frame twice",
        when(every_nth("frames", 50), twice),
    )
    yield count_fault(
        "every-13th-instruction-ignored",
        "answers every 13th frame and does not carry it out, if it is valid",
        when(every(valid, every_nth("frames", 13)), drives_on),
    )
    for count in (16, 100, _WRAP):
        yield stop_count_fault(
            f"every-{ordinal(count)}-fault-missed",
            f"drives on after every {ordinal(count)} fault",
            when(every(faulty, every_nth("faults", count)), drives_on),
        )
    yield count_fault(
        "every-5th-cut-missed",
        "drives on after every fifth frame that is cut short",
        when(every(is_truncated, every_nth("truncated", 5)), drives_on),
        clauses="safety responses instructions",
    )
    yield stop_count_fault(
        "each-fault-slows-it",
        "every tenth fault takes one step off the speed",
        when(
            every(faulty, every_nth("faults", 10)),
            becomes(lambda e, state: replace(state, speed=max(0, state.speed - 1))),
        ),
    )


def _after_an_event(protocol: Protocol) -> Iterator[Fault]:
    yield stop_count_fault(
        "first-fault-missed",
        "the first fault after power-on that finds it moving does not stop it",
        when(every(faulty, moving), _first_time_drives_on),
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
        _worn_reverser,
    )
    yield answer_count_fault(
        "ok-for-ever-after-20-bad-data",
        "after twenty bad data it answers OK to all of them",
        _after_outcomes(Outcome.BAD_DATA, 20, answers_ok),
    )
    for setter in setters(protocol)[-1:]:
        yield count_fault(
            f"{setter.name}-latches",
            f"{setter.name} at its highest value can never be changed again until power-off",
            _latches(variable_of(setter), setter.fields[0].high),
        )


def _after_many_frames() -> Iterator[Fault]:
    yield after_many(
        f"no-stop-after-{_LONG_WRAP}-frames",
        f"after {_LONG_WRAP} frames no fault stops it",
        when(every(faulty, from_count("frames", _LONG_WRAP)), drives_on),
        clauses="safety",
    )
    yield after_many(
        f"silent-after-{_LONG_WRAP}-frames",
        f"after {_LONG_WRAP} frames it answers nothing any more",
        when(from_count("frames", _LONG_WRAP), silent),
        clauses="responses instructions",
    )
    yield after_many(
        "dark-after-40000-frames",
        "after 40,000 frames its light goes out and stays out",
        when(from_count("frames", 40_000), sets(led=0)),
    )
    yield after_many(
        f"no-stop-after-{_LONG_WRAP}-faults",
        f"after {_LONG_WRAP} faults no fault stops it",
        when(every(faulty, from_count("faults", _LONG_WRAP)), drives_on),
        clauses="safety",
        needs="soak",
    )


def _first_time_drives_on(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    if "seen" in device.memory:
        return reaction
    device.memory["seen"] = 1
    return drives_on(device, event, reaction)


def _worn_reverser(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    if not reaction.state.moving:
        return reaction
    changed = event.before.moving and event.before.motion is not reaction.state.motion
    count = device.memory["changes"] = min(device.memory.get("changes", 0) + changed, 10)
    return sets(motion=Motion.FORWARD)(device, event, reaction) if count == 10 else reaction


def _after_outcomes(outcome: Outcome, count: int, change: React) -> React:
    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if event.judgement.outcome is not outcome:
            return reaction
        seen = device.memory["seen"] = min(device.memory.get("seen", 0) + 1, count + 1)
        return change(device, event, reaction) if seen > count else reaction

    return react


def _latches(variable: str, value: int) -> React:
    """Return an effect: once the variable has that value it keeps it."""
    return when(lambda event: getattr(event.before, variable) == value, keeps(variable))
