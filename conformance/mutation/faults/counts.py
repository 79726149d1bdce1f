"""Faults triggered by history: after N frames or faults, at every Nth, or once and for good."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.vocabulary import (
    EVERYTHING,
    SEQUENCE,
    SOAK,
    WATCHED_FAULTS,
    Condition,
    answers_with,
    becomes,
    drives_on,
    every,
    faulty,
    is_named,
    is_outcome,
    ordinal,
    sets,
    twice,
    valid,
    when,
)
from bilprov.spec.by_effect import movers, setters, variable_of
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol

_FAMILY = "history"
_WRAP, _LONG_WRAP = 1 << 8, 1 << 16


def count_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that a count of frames or faults, or a latched event, triggers."""
    yield from _after_so_many(protocol)
    yield from _every_so_often(protocol)
    yield from _latched(protocol)
    yield from _only_a_soak(protocol)


def _after_so_many(protocol: Protocol) -> Iterator[Fault]:
    for count in (50, 200, 290):
        yield _fault(
            f"no-stop-after-{count}-faults",
            f"after {count} faults it no longer stops for one",
            when(lambda e, n=count: faulty(e) and e.faults >= n, drives_on),  # type: ignore[misc]
            "safety",
        )
    for count in (5, 20):
        yield _fault(
            f"silent-after-{count}-faults-in-a-row",
            f"after {count} faults without a valid instruction between it answers none more",
            when(lambda e, n=count: faulty(e) and e.row >= n, answers_with()),  # type: ignore[misc]
            *("responses", "instructions"),
        )
    settings = setters(protocol)
    for count, setter in zip((100, 200, 300, 255), settings, strict=False):
        yield _fault(
            f"{setter.name}-sticks-after-{count}-frames",
            f"after {count} frames {setter.name} is answered and no longer carried out",
            when(every(is_named(setter), _after(count)), drives_on),
            "instructions",
        )
    for count, mover in zip((60, 256), movers(protocol), strict=False):
        yield _fault(
            f"{mover.name}-dead-after-{count}-frames",
            f"after {count} frames {mover.name} is answered and does not move it",
            when(every(is_named(mover), _after(count)), drives_on),
            "instructions",
        )


def _every_so_often(protocol: Protocol) -> Iterator[Fault]:
    for count in (10, 100, _WRAP):
        yield _fault(
            f"every-{ordinal(count)}-frame-unanswered",
            f"carries out every {ordinal(count)} frame and does not answer it",
            when(_every(count), answers_with()),
            *("responses", "instructions"),
        )
    yield _fault(
        "every-50th-frame-answered-twice",
        "answers every 50th frame twice",
        when(_every(50), twice),
        *("responses", "instructions"),
    )
    yield _fault(
        "every-13th-instruction-ignored",
        "answers every 13th frame and does not carry it out, if it is valid",
        when(every(valid, _every(13)), drives_on),
        "instructions",
    )
    for count in (16, 100, _WRAP):
        yield _fault(
            f"every-{ordinal(count)}-fault-missed",
            f"drives on after every {ordinal(count)} fault",
            when(
                lambda e, n=count: faulty(e) and e.faults % n == n - 1,  # type: ignore[misc]
                drives_on,
            ),
            *("safety", "instructions"),
        )
    yield _fault(
        "every-5th-cut-missed",
        "drives on after every fifth frame that is cut short",
        when(lambda e: e.kind == "truncated" and e.truncated % 5 == 4, drives_on),
        *("safety", "responses", "instructions"),
    )
    yield _fault(
        "each-fault-slows-it",
        "every tenth fault takes one step off the speed",
        when(
            lambda e: faulty(e) and e.faults % 10 == 9,
            becomes(lambda e, s: replace(s, speed=max(0, s.speed - 1))),
        ),
        *("safety", "instructions"),
    )


def _latched(protocol: Protocol) -> Iterator[Fault]:
    ok = protocol.answers[Outcome.VALID].code
    yield replace(
        _fault(
            "first-fault-missed",
            "the first fault after power-on that finds it moving does not stop it",
            _first_while_moving,
            *("safety", "instructions"),
        ),
        caught_by=("power-on/first-fault",),
    )
    yield _fault(
        "bad-data-fine-once-too-many-came",
        "once too many data bytes came, bad data is answered OK and does not stop it for ever",
        _bad_data_fine_once_too_many,
        *("safety", "instructions", "responses"),
    )
    yield _fault(
        "stuck-forward-after-10-reversals",
        "after ten changes of motion while it moves, each motion is the first one",
        _worn_reverser(10),
        "instructions",
    )
    yield _fault(
        "ok-for-ever-after-20-bad-data",
        "after twenty bad data it answers OK to all of them",
        _after_outcomes(Outcome.BAD_DATA, 20, answers_with(ok)),
        *("responses", "instructions"),
    )
    for setter in setters(protocol)[-1:]:
        yield _fault(
            f"{setter.name}-latches",
            f"{setter.name} at its highest value can never be changed again until power-off",
            _latching(variable_of(setter), setter.fields[0].high),
            "instructions",
        )


def _only_a_soak(protocol: Protocol) -> Iterator[Fault]:
    yield _fault(
        f"no-stop-after-{_LONG_WRAP}-frames",
        f"after {_LONG_WRAP} frames no fault stops it",
        when(every(faulty, _after(_LONG_WRAP)), drives_on),
        "safety",
        needs="soak",
    )
    yield _fault(
        f"silent-after-{_LONG_WRAP}-frames",
        f"after {_LONG_WRAP} frames it answers nothing any more",
        when(_after(_LONG_WRAP), answers_with()),
        *("responses", "instructions"),
        needs="soak",
    )
    yield _fault(
        "dark-after-40000-frames",
        "after 40,000 frames its light goes out and stays out",
        when(_after(40_000), sets(led=0)),
        "instructions",
        needs="soak",
    )


def _fault(name: str, doc: str, react: React, *clauses: str, needs: str = "") -> Fault:
    cases = SOAK if needs else SEQUENCE
    return Fault(name.lower(), _FAMILY, doc, cases, react=react, clauses=clauses, needs=needs)


def _after(count: int) -> Condition:
    return lambda event: event.frames >= count


def _every(count: int) -> Condition:
    return lambda event: event.frames % count == count - 1


def _first_while_moving(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    if event.judgement.valid or not event.before.moving or "seen" in device.memory:
        return reaction
    device.memory["seen"] = 1
    return replace(reaction, state=event.before)


def _bad_data_fine_once_too_many(
    device: MutatedDevice, event: Event, reaction: Reaction
) -> Reaction:
    if is_outcome(Outcome.TOO_MANY)(event):
        device.memory["lax"] = 1
    elif is_outcome(Outcome.BAD_DATA)(event) and "lax" in device.memory:
        ok = device.protocol.answers[Outcome.VALID].code
        return replace(answers_with(ok)(device, event, reaction), state=event.before)
    return reaction


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


def history_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults of this family that show after a number of faults."""
    family = "history"
    for count in (10, 100):
        yield Fault(
            f"no-stop-after-{count}-faults",
            family,
            f"after {count} faults it no longer stops for one",
            WATCHED_FAULTS,
            react=when(
                lambda e, count=count: not e.judgement.valid and e.faults >= count,  # type: ignore[misc]
                drives_on,
            ),
        )
    yield Fault(
        "sticks-after-50-faults",
        family,
        "after 50 faults it answers nothing any more",
        EVERYTHING,
        react=when(lambda e: e.faults >= 50, answers_with()),
    )
    yield Fault(
        "every-7th-fault-missed",
        family,
        "drives on after every seventh fault",
        WATCHED_FAULTS,
        react=when(lambda e: not e.judgement.valid and e.faults % 7 == 6, drives_on),
    )
