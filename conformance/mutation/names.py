"""The protocol's own names and numbers, for the templates of faults and variants.

A template is text with placeholders such as `{stop}`, `{setters[0].high}` or `{each}`. One that
names what a protocol does not have is left out for that protocol.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

from bilprov.conformance.mutation.triggers import OUTCOMES
from bilprov.spec.by_effect import movers, moving_motions, setters, variable_of
from bilprov.spec.codec import bad_data
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import InstructionSpec, Protocol


class Name(str):
    """A name with attributes: numbers of an instruction, or an outcome in words."""


def _name(text: str, **attributes: object) -> Name:
    name = Name(text)
    vars(name).update(attributes)
    return name


def _instruction(protocol: Protocol, spec: InstructionSpec) -> Name:
    """Return an instruction's name, with what it sets and numbers of its first field.

    `one_bit_more` is the first value that has two bits more than those that are named, `bad_half`
    and `bad_upper` are values half way and two thirds through the bad ones.
    """
    attributes: dict[str, object] = {"id": spec.id, "motion": protocol.car.motion(spec.effect)}
    if spec.effect.assignments:
        attributes["variable"] = protocol.role_of[variable_of(spec)]
    for part in spec.fields[:1]:
        attributes |= {
            "header": protocol.header_bytes[spec.id, spec.length],
            "low": part.low,
            "middle": (part.low + part.high + 1) // 2,
            "high": part.high,
            "width": len(part.bits),
            "lowest_bit": part.bits[-1:],
            "one_bit_more": 2 << len(part.bits),
            "top": 8 * part.size - 1,
            "top_mask": 1 << 8 * part.size - 1,
        }
        bad = [spec.decode(data)[part.name] for data in bad_data(spec)]
        if bad:
            half, upper = bad[len(bad) // 2], bad[len(bad) * 2 // 3]
            attributes |= {"bad_half": half, "bad_upper": upper}
    return _name(spec.name, **attributes)


@cache
def names(protocol: Protocol) -> dict[str, Any]:
    """Return what placeholders stand for; the lists are what `each` of a row may go over."""

    def named(specs: Iterable[InstructionSpec]) -> list[Name]:
        return [_instruction(protocol, spec) for spec in specs]

    timing, motions = protocol.timing, list(moving_motions(protocol))
    roles = protocol.role_of
    tops = {roles[name]: high for name, (_, high) in protocol.limits.items()}
    settings = [
        (roles[variable_of(spec)], _instruction(protocol, spec)) for spec in setters(protocol)
    ]
    lit = named(s for s in protocol.instructions if any(part.bits for part in s.fields))
    found: dict[str, Any] = {
        "answer": {word: protocol.answers[outcome].name for word, outcome in OUTCOMES.items()},
        "code": {word: protocol.answers[outcome].code for word, outcome in OUTCOMES.items()},
        "unused_code": next(code for code in range(256) if code not in protocol.codes),
        "responses": protocol.responses,
        "outcomes": [
            _name(word, words=outcome.value)
            for word, outcome in OUTCOMES.items()
            if outcome is not Outcome.VALID
        ],
        "motions": motions,
        "still": protocol.car.still,
        "measured_motion": min(motions, default=""),
        "other_motions": [motion for motion in motions if motion != min(motions)],
        "movers": named(movers(protocol)),
        "moving": named(s for s in protocol.instructions if protocol.car.moves(s.effect)),
        "setters": [name for _, name in settings],
        "setting": dict(settings[::-1]),
        "steering": [name for variable, name in settings if variable == "steering"],
        "stop": _instruction(protocol, protocol.stop),
        "lit": lit,
        "bits": [name for name in lit if hasattr(name, "bad_half")],
        "unused": protocol.unused_ids,
        "longest": protocol.data_lengths[-1],
        "top": tops,
        "some": {name: tops.get(name, 0) // part for name, part in _SOME.items()},
        "timeout": int(timing.truncation_timeout),
        "late_answer": 1.2 * timing.answer_longest,
        "late_stop": 3 * timing.stop_longest,
    }
    ends = {"last_motion": motions, "last_unused": protocol.unused_ids}
    found |= {name: values[-1] for name, values in ends.items() if values}
    if "speed" in tops:
        found |= {"half_speed": tops["speed"] // 2, "high_speed": tops["speed"] * 3 // 4}
    if protocol.instructions[-1].effect.assignments:
        found["last"] = _instruction(protocol, protocol.instructions[-1])
    return found


_SOME = {"speed": 3, "led": 1, "steering": 12}
"""Variables and the part of the highest value that some device has at power-on."""
