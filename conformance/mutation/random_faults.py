"""Draws random faults: a trigger (frame, state, data, history, timing) and an effect.

A seed gives the same fault on every machine and with every Python.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from functools import cache, partial
from operator import xor
from typing import NamedTuple, TypeVar

from bilprov.captures.schemas import MS
from bilprov.captures.text import ordinal
from bilprov.conformance.dut.fault import Event, Fault, Hear, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.vocabulary import (
    FAULTY,
    Condition,
    after,
    after_a_fault,
    answers_again,
    answers_ok,
    answers_with,
    drives_on,
    every,
    every_nth,
    faulty,
    from_count,
    has_id,
    has_length,
    is_named,
    is_outcome,
    is_truncated,
    late,
    moving_in,
    pipelined,
    resizes,
    resumes_after,
    sets,
    silent,
    split,
    standing,
    stands_still,
    steered_to,
    stops_after,
    twice,
    when,
)
from bilprov.spec.by_effect import moving_motions, variable_of
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import InstructionSpec, Protocol

T = TypeVar("T")
PREFIX = "random:"


class Draw:
    """Random draws, made with `random()` alone because only it is the same in every Python."""

    def __init__(self, seed: int) -> None:
        self._next = random.Random(seed).random

    def below(self, end: int) -> int:
        """Return a whole number from 0 to `end` - 1."""
        return int(self._next() * end)

    def pick(self, choices: Sequence[T]) -> T:
        """Return one of the choices."""
        return choices[self.below(len(choices))]

    def between(self, low: int, high: int) -> int:
        """Return a whole number from `low` to `high`, both included."""
        return low + self.below(high - low + 1)


class What(NamedTuple):
    """The frames that trigger a fault: their description, the condition, and their kind.

    `spec` is the instruction of valid frames, None for faulty ones; `outcome` is their kind of
    fault, None for any; `cut` is true for truncated frames.
    """

    words: str
    condition: Condition
    spec: InstructionSpec | None = None
    outcome: Outcome | None = None
    cut: bool = False


class When(NamedTuple):
    """A further condition of the trigger, its words, and data values around which it holds."""

    words: str
    condition: Condition
    hints: tuple[int, ...] = ()


class Effect(NamedTuple):
    """One effect: its hooks, and words that continue the description of the trigger."""

    words: str
    react: React
    hear: Hear | None = None


@cache
def random_fault(protocol: Protocol, seed: int) -> Fault:
    """Return the fault that a seed draws."""
    draw = Draw(seed)
    what = _what(protocol, draw)
    kinds = [_state, _state, _history, _timing, *([_data] * 3 if _has_data(what) else [])]
    count = draw.pick((0, 1, 1, 1, 1, 2))
    chosen: list[When] = []
    for _ in range(count):
        kind = draw.pick(kinds)
        kinds = [other for other in kinds if other is not kind]
        chosen.append(kind(protocol, draw, what))
    effect = draw.pick(_effects(protocol, draw, what))
    conditions = ", ".join((what.words, *(one.words for one in chosen)))
    return Fault(
        f"{PREFIX}{seed}",
        "random",
        f"{conditions}: {effect.words}",
        ("*",),
        react=when(every(what.condition, *(one.condition for one in chosen)), effect.react),
        hear=effect.hear,
        clauses=("safety", "responses", "instructions", "header"),
        hints=tuple(hint for one in chosen for hint in one.hints),
    )


def _what(protocol: Protocol, draw: Draw) -> What:
    kind = draw.below(10)
    if kind < 5:
        spec = draw.pick(protocol.instructions)
        return What(f"a valid {spec.name}", is_named(spec), spec)
    if kind < 7:
        outcome = draw.pick(FAULTY)
        return What(outcome.value, is_outcome(outcome), outcome=outcome)
    if kind == 7:
        return What("a frame that is cut short", is_truncated, cut=True)
    if kind == 8 and protocol.unused_ids:
        identity = draw.pick(protocol.unused_ids)
        words = f"the unused ID {identity}"
        return What(words, has_id(identity), outcome=Outcome.UNKNOWN_ID)
    return What("any fault", faulty)


def _has_data(what: What) -> bool:
    return bool(what.spec.fields) if what.spec else not what.cut


def _state(protocol: Protocol, draw: Draw, what: What) -> When:
    _, fast = protocol.limits.get("speed", (0, 1))
    _, lit = protocol.limits.get("led", (0, 0))
    kind = draw.below(7 if lit else 6)
    if kind < 3:
        motion = draw.pick(moving_motions(protocol))
        return When(f"while it moves {motion.value}", moving_in(motion))
    if kind == 3 and what.spec and what.spec.effect.motion is not Motion.STOPPED:
        return When("while it stands", standing)
    if kind in (3, 4):
        least = draw.between(1, fast)
        return When(
            f"at a speed from {least}",
            lambda event: event.before.speed >= least,
            (least, least - 1),
        )
    if kind == 5:
        sign = draw.pick((-1, 1))
        side = "right" if sign > 0 else "left"
        return When(f"steered to the {side}", steered_to(sign))
    mask = 1 << draw.below(lit.bit_length())
    return When(
        f"with the light's bit {mask:#x} on", lambda event: bool(event.before.led & mask), (mask,)
    )


def _data(protocol: Protocol, draw: Draw, what: What) -> When:
    if what.spec is None:
        if what.outcome is Outcome.BAD_DATA:
            bit = draw.below(8)
            return When(
                f"with bit {bit} of its data",
                lambda event: _value(event) >> bit & 1 == 1,
                (1 << bit,),
            )
        if draw.below(2):
            odd = draw.below(2)
            words = "an odd" if odd else "an even"
            return When(
                f"with {words} announced length", lambda event: event.judgement.length % 2 == odd
            )
        length = draw.pick(protocol.data_lengths)
        return When(f"with {length} data bytes announced", has_length(length))
    part = what.spec.fields[0]
    kind = draw.below(4)
    if kind == 0:
        value = draw.between(part.low, part.high)
        return When(f"with the value {value}", lambda event: _value(event) == value, (value,))
    if kind == 1:
        least = draw.between(part.low + 1, part.high)
        return When(
            f"with a value from {least}", lambda event: _value(event) >= least, (least, least - 1)
        )
    bit = draw.below(max(1, part.high.bit_length()))
    on = draw.below(2)
    words = "set" if on else "clear"
    return When(
        f"with bit {bit} {words}", lambda event: _value(event) >> bit & 1 == on, (1 << bit, 0)
    )


def _value(event: Event) -> int:
    fields = event.judgement.fields
    return fields[0][1] if fields else 0


def _history(protocol: Protocol, draw: Draw, what: What) -> When:
    kind = draw.below(7)
    if kind < 3:
        spec = draw.pick(protocol.instructions)
        return When(f"right after {spec.name}", after(spec))
    if kind == 3:
        return When("right after a fault", after_a_fault)
    if kind == 4:
        step = draw.between(2, 40)
        return When(f"as every {ordinal(step)} frame", every_nth("frames", step))
    if kind == 5:
        count = draw.between(5, 250)
        return When(f"after {count} frames", from_count("frames", count))
    count = draw.between(2, 60)
    return When(f"after {count} faults", from_count("faults", count))


def _timing(protocol: Protocol, draw: Draw, what: What) -> When:
    carries = what.spec.length if what.spec else 2
    kind = draw.below(3 if carries and not what.cut else 2)
    if kind == 0:
        return When("sent ahead of the answer before", pipelined)
    if kind == 1:
        pause = draw.pick((15, 30, 60))
        return When(
            f"after {pause} ms without a frame",
            lambda event: event.gap is not None and event.gap >= pause * MS,
        )
    return When("with a pause between its bytes", split)


def _effects(protocol: Protocol, draw: Draw, what: What) -> list[Effect]:
    """Return the effects that a fault may have on such frames; no reading allows them.

    An effect that stands in the list several times is drawn more often.
    """
    found, spec = _answers(protocol, draw, what), what.spec
    if spec is None:
        found += 3 * [Effect("does not stop it", drives_on)]
        too_late = stops_after(3 * protocol.timing.stop_longest)
        found.append(Effect("stops it much too late", too_late))
        found += [_resumes(pause) for pause in (12, 60, 120)]
        return found + _astray(protocol, draw, ("led", "speed"))
    motion = spec.effect.motion
    if motion is Motion.STOPPED:
        found += 2 * [Effect("does nothing", drives_on), _resumes(15)]
        return found + _astray(protocol, draw, ("led",))
    if not spec.effect.assignments:
        return found
    found += 3 * [Effect("is answered and not carried out", drives_on)]
    if motion is None:
        own = variable_of(spec)
        others = [name for name in ("speed", "led", "steering") if name != own]
        found += 2 * _astray(protocol, draw, (own,)) + _astray(protocol, draw, others)
        return [*found, Effect("stops it", stands_still)]
    motions = [other for other in moving_motions(protocol) if other is not motion]
    if motions:
        other = draw.pick(motions)
        found.append(Effect(f"moves it {other.value}", sets(motion=other)))
    return found + _astray(protocol, draw, ("speed", "led"))


def _answers(protocol: Protocol, draw: Draw, what: What) -> list[Effect]:
    ok = protocol.answers[Outcome.VALID]
    code = draw.pick([code for code in range(256) if code not in protocol.codes])
    found = [
        Effect(f"is answered {code}, an unused code", answers_with(code)),
        Effect("is answered twice", twice),
        Effect("is answered again 12 ms later", answers_again(12)),
        Effect("is answered much too late", late(1.2 * protocol.timing.answer_longest)),
        Effect("makes it lose the next byte", _marks, _loses),
    ]
    if what.spec:
        given = draw.pick([spec for spec in protocol.responses if spec.code != ok.code])
        found.append(Effect(f"is answered {given.name}", answers_with(given.code)))
    else:
        found.append(Effect(f"is answered {ok.name}, but stops it", answers_ok))
        if what.outcome is not None or what.cut:
            bad = what.outcome in (None, Outcome.UNKNOWN_ID)
            wrong = protocol.answers[Outcome.BAD_DATA if bad else Outcome.UNKNOWN_ID]
            found.append(Effect(f"is answered {wrong.name}", answers_with(wrong.code)))
    if what.outcome is not None or what.spec:  # not to answer a truncated frame is legal
        found.append(Effect("is not answered", silent))
    return found


def _resumes(pause: int) -> Effect:
    return Effect(f"stops it, and it drives on {pause} ms later", resumes_after(pause))


def _astray(protocol: Protocol, draw: Draw, variables: Iterable[str]) -> list[Effect]:
    """Return effects that turn one bit of a variable; readings allow only to keep or zero it."""
    found = []
    for name in variables:
        if name in protocol.limits:
            bit = draw.below(max(1, protocol.limits[name][1].bit_length()))
            turned = resizes(name, partial(xor, 1 << bit))
            found.append(Effect(f"turns bit {bit} of the {name}", turned))
    return found


def _marks(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    device.memory["deaf"] = 1
    return reaction


def _loses(device: MutatedDevice, data: bytes, now: int) -> bytes:
    return b"" if device.memory.pop("deaf", 0) else data
