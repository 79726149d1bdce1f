"""Draws random faults from six families; most are a trigger and an effect.

A simple fault is triggered by a frame and further conditions. A needle is a value in the data of
frames that are already faulty. A fault in context needs a frame, its data, and what came before or
the state. A rhythm is every n-th frame of a class. Disobedience depends on settings in which the
robot answers and does nothing. Wheels go astray where they turn at another speed than was set.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from bilprov.captures.schemas import Look
from bilprov.captures.text import ordinal
from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.draw import Draw
from bilprov.conformance.mutation.faults.vocabulary import (
    FAULTY,
    Condition,
    after,
    after_outcome,
    after_truncated,
    answers_with,
    drives_on,
    every,
    faulty,
    is_named,
    is_outcome,
    silent,
    steered_to,
    twice,
    valid,
    when,
)
from bilprov.conformance.mutation.random_effects import Effect, again, effects
from bilprov.conformance.mutation.random_frames import faulty_frames, with_byte, with_first_value
from bilprov.conformance.mutation.random_triggers import (
    What,
    When,
    frames,
    has_data,
    in_a_state,
    with_data,
    with_history,
    with_timing,
)
from bilprov.spec.by_effect import moves
from bilprov.spec.motion import Motion, State, wheels
from bilprov.spec.protocol import Protocol

Change = Callable[[int], int]
_PERIODS = (64, 100, 256, 1000)  # besides any from 20 to 300
_LOWEST_BIT = 4  # of a speed or strength: a smaller difference is none that a sweep must tell


def simple(protocol: Protocol, draw: Draw) -> Fault:
    """Return a fault of a frame, and up to two of: state, data, history, timing."""
    what = frames(protocol, draw)
    kinds = [
        in_a_state,
        in_a_state,
        with_history,
        with_timing,
        *([with_data] * 3 if has_data(what) else []),
    ]
    count = draw.pick((0, 1, 1, 1, 1, 2))
    chosen: list[When] = []
    for _ in range(count):
        kind = draw.pick(kinds)
        kinds = [other for other in kinds if other is not kind]
        chosen.append(kind(protocol, draw, what))
    return _triggered("random", what, chosen, draw.pick(effects(protocol, draw, what)))


def needle(protocol: Protocol, draw: Draw) -> Fault:
    """Return a fault of faulty frames with a value in their data, sometimes in one state only."""
    found = faulty_frames(protocol, draw)
    conditions = [with_byte(draw, found, any_value=not found.narrow)]
    if not found.narrow and draw.below(3) == 0:
        conditions.append(in_a_state(protocol, draw, found.what))
    effect = draw.pick(effects(protocol, draw, found.what, in_silence=False))
    return _triggered("random needle", found.what, conditions, effect)


def in_context(protocol: Protocol, draw: Draw) -> Fault:
    """Return a fault of a frame, a value in it, and the frame before or the state."""
    carriers = [spec for spec in protocol.instructions if spec.fields]
    in_state = draw.below(5) == 0  # where any value is met often enough; elsewhere one of a few
    if carriers and draw.below(2):
        spec = draw.pick(carriers)
        what = What(f"a valid {spec.name}", is_named(spec), spec)
        conditions = [with_first_value(draw, spec.fields[0], any_value=in_state)]
        hints: tuple[bytes, ...] = ()
    else:
        found = faulty_frames(protocol, draw)
        what = found.what
        conditions = [] if found.narrow else [with_byte(draw, found, any_value=in_state)]
        hints = () if conditions else (found.frame,)
    before = in_a_state if in_state else _right_after
    conditions.append(before(protocol, draw, what))
    effect = draw.pick(effects(protocol, draw, what, in_silence=False))
    return _triggered("random context", what, conditions, effect, hints)


def rhythm(protocol: Protocol, draw: Draw) -> Fault:
    """Return a fault of every n-th frame, fault, or frame of a class, sometimes in one state."""
    what = _counted(protocol, draw)
    period = draw.pick((*_PERIODS, draw.between(20, 300)))
    states = [in_a_state(protocol, draw, what)] if draw.below(3) == 0 else []
    matches = _all_of(what, states)
    counts_all = draw.below(2) == 0
    effect = draw.pick(_at_times(protocol, draw, what))
    words = f"each {ordinal(period)} time, {_words(what, states)}"
    if states and counts_all:
        words += f", counting {what.words} in any state"
    return _fault(
        "random rhythm",
        f"{words}: {effect.words}",
        react=_every_nth(period, what.condition if counts_all else matches, matches, effect.react),
        hear=effect.hear,
        hints=_hints(states),
    )


def disobedience(protocol: Protocol, draw: Draw) -> Fault:
    """Return a fault of settings in which instructions are answered and not carried out."""
    settings = []
    if "speed" in protocol.limits:
        least = draw.between(2, protocol.limits["speed"][1])
        settings.append(
            When(
                f"from speed {least} on",
                lambda event: event.before.speed >= least,
                (least, least - 1),
            )
        )
    if protocol.limits.get("led", (0, 0))[1]:
        mask = 1 << draw.below(protocol.limits["led"][1].bit_length())
        lit = When(
            f"while the light's bit {mask:#x} is on",
            lambda event: bool(event.before.led & mask),
            (mask,),
        )
        settings += [lit, lit]
    if "steering" in protocol.limits:
        sign = draw.pick((-1, 1))
        side = "right" if sign > 0 else "left"
        settings.append(When(f"while steered to the {side}", steered_to(sign)))
    if not settings:
        return simple(protocol, draw)
    what = draw.pick(
        (
            What("a valid instruction", valid),
            What("an instruction that moves it", every(valid, _moves)),
            What("an instruction that does not move it", every(valid, lambda e: not _moves(e))),
        )
    )
    effect = Effect("is answered and does nothing", drives_on)
    return _triggered("random settings", what, [draw.pick(settings)], effect)


def wheels_astray(protocol: Protocol, draw: Draw) -> Fault:
    """Return a fault of the wheels: at some speeds or strengths they turn slower, or backwards."""
    names = [
        name
        for name in ("speed", "steering")
        if protocol.limits.get(name, (0, 0))[1] >= 2 << _LOWEST_BIT
    ]
    if not names:
        return simple(protocol, draw)
    name = draw.pick(names)
    high = protocol.limits[name][1]
    bit = draw.between(_LOWEST_BIT, high.bit_length() - 1)
    least = draw.between(2 << _LOWEST_BIT, high)
    kinds: list[tuple[str, Change, int]] = [
        (f"bit {bit} of the {name} is lost", lambda size: size & ~(1 << bit), 1 << bit),
        (f"half at a {name} of {least}", lambda size: size // 2 if size == least else size, least),
        (
            f"half from a {name} of {least} on",
            lambda size: size // 2 if size >= least else size,
            least,
        ),
        (
            f"reversed from a {name} of {least} on",
            lambda size: -size if size >= least else size,
            least,
        ),
    ]
    words, change, value = draw.pick(kinds)
    full = max(abs(end) for end in protocol.limits.get("steering", (0, 0)))

    def show(look: Look) -> Look:
        speed, steering = look.speed or 0, look.steering or 0
        if name == "speed":
            speed = change(speed)
        else:
            steering = change(abs(steering)) * (1 if steering > 0 else -1)
        left, right = wheels(
            State(Motion(look.motion or Motion.STOPPED), abs(speed), steering), full
        )
        sign = -1 if speed < 0 else 1
        return msgspec.structs.replace(look, left=sign * left, right=sign * right)

    return _fault("random wheels", f"the wheels turn wrongly: {words}", show=show, hints=(value,))


def _right_after(protocol: Protocol, draw: Draw, what: What) -> When:
    """Draw what came right before: an answer, an instruction, a cut frame."""
    kind = draw.below(4)
    if kind < 2:
        outcome = draw.pick(FAULTY)
        code = protocol.answers[outcome].name
        return When(f"right after {code}", after_outcome(outcome))
    if kind == 2:
        spec = draw.pick(protocol.instructions)
        return When(f"right after {spec.name}", after(spec))
    return When("right after a frame that was cut short", after_truncated)


def _counted(protocol: Protocol, draw: Draw) -> What:
    """Draw what a rhythm counts: all frames, all faults, an instruction, or a kind of fault."""
    kind = draw.below(5)
    if kind < 2:
        return What("a frame", lambda event: True)
    if kind == 2:
        return What("a fault", faulty)
    if kind == 3:
        spec = draw.pick(protocol.instructions)
        return What(f"a valid {spec.name}", is_named(spec), spec)
    outcome = draw.pick(FAULTY)
    return What(outcome.value, is_outcome(outcome), outcome=outcome)


def _at_times(protocol: Protocol, draw: Draw, what: What) -> list[Effect]:
    """Return the effects of a rhythm: mostly on the answer."""
    code = draw.pick([code for code in range(256) if code not in protocol.codes])
    other = draw.pick(protocol.responses)
    found = [
        Effect("is answered twice", twice),
        Effect("is not answered", silent),
        Effect(f"is answered {code}, an unused code", answers_with(code)),
        Effect(f"is answered {other.name}", answers_with(other.code)),
        again(12, in_silence=False),
    ]
    if what.spec or what.outcome:
        found.append(draw.pick(effects(protocol, draw, what, in_silence=False)))
    return found


def _every_nth(period: int, counted: Condition, matches: Condition, change: React) -> React:
    """Return an effect: the change, at matching frames, each time that `period` were counted."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        if not counted(event):
            return reaction
        turn = device.memory["turn"] = (device.memory.get("turn", 0) + 1) % period
        return reaction if turn or not matches(event) else change(device, event, reaction)

    return react


def _moves(event: Event) -> bool:
    instruction = event.judgement.instruction
    return instruction is not None and moves(instruction)


def _triggered(
    family: str,
    what: What,
    conditions: Sequence[When],
    effect: Effect,
    hints: tuple[bytes, ...] = (),
) -> Fault:
    """Return the fault that has the effect on such frames under all of the conditions.

    `hints` are frames to add to those that the conditions give.
    """
    return _fault(
        family,
        f"{_words(what, conditions)}: {effect.words}",
        react=when(_all_of(what, conditions), effect.react),
        hear=effect.hear,
        hints=(*hints, *_hints(conditions)),
    )


def _words(what: What, conditions: Sequence[When]) -> str:
    return ", ".join((what.words, *(one.words for one in conditions)))


def _all_of(what: What, conditions: Sequence[When]) -> Condition:
    return every(what.condition, *(one.condition for one in conditions))


def _hints(conditions: Sequence[When]) -> tuple[int | bytes, ...]:
    return tuple(hint for one in conditions for hint in one.hints)


def _fault(family: str, doc: str, **hooks: Any) -> Fault:
    """Return a fault that any case may catch; who draws it names it."""
    clauses = ("safety", "responses", "instructions", "header")
    return Fault("", family, doc, ("*",), clauses=clauses, **hooks)
