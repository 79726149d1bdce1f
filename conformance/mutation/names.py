"""The protocol's own names and numbers, for the templates of faults and variants.

A template is text with placeholders such as `{stop}`, `{setters[0].high}` or `{each}`. One that
names what a protocol does not have is left out for that protocol.
"""

from __future__ import annotations

from functools import cache, cached_property
from typing import Any

from bilprov.conformance.mutation.triggers import OUTCOMES
from bilprov.spec.by_effect import movers, moving_motions, setters, variable_of
from bilprov.spec.codec import bad_data
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import FieldSpec, InstructionSpec, Protocol


class Instruction(str):
    """An instruction's name, with numbers of its first field."""

    spec: InstructionSpec
    protocol: Protocol

    @property
    def _field(self) -> FieldSpec:
        return self.spec.fields[0]

    @property
    def id(self) -> int:
        """Its ID."""
        return self.spec.id

    @property
    def header(self) -> int:
        """Its header byte."""
        return self.protocol.header_bytes[self.spec.id, self.spec.length]

    @property
    def motion(self) -> str:
        """The motion that it sets."""
        return str(self.spec.effect.motion)

    @property
    def variable(self) -> str:
        """The variable that it sets."""
        return variable_of(self.spec)

    @property
    def low(self) -> int:
        """The lowest value."""
        return self._field.low

    @property
    def high(self) -> int:
        """The highest value."""
        return self._field.high

    @property
    def middle(self) -> int:
        """The value in the middle."""
        return (self._field.low + self._field.high + 1) // 2

    @property
    def width(self) -> int:
        """The number of named bits."""
        return len(self._field.bits)

    @property
    def lowest_bit(self) -> str:
        """The name of the lowest bit."""
        return self._field.bits[-1]

    @property
    def top(self) -> int:
        """The number of the highest bit of its byte."""
        return 8 * self._field.size - 1

    @property
    def top_mask(self) -> int:
        """The highest bit of its byte."""
        return 1 << self.top

    @property
    def one_bit_more(self) -> int:
        """The first value that has two bits more than those that are named."""
        return 2 << self.width

    @cached_property
    def _bad(self) -> list[int]:
        return [self.spec.decode(data)[self._field.name] for data in bad_data(self.spec)]

    @property
    def bad_half(self) -> int:
        """A bad value half way through them."""
        return self._bad[len(self._bad) // 2]

    @property
    def bad_upper(self) -> int:
        """A bad value two thirds through them."""
        return self._bad[len(self._bad) * 4 // 6]


class Words(str):
    """An outcome as triggers write it, with its words."""

    words: str


def _instruction(protocol: Protocol, spec: InstructionSpec) -> Instruction:
    named = Instruction(spec.name)
    named.spec, named.protocol = spec, protocol
    return named


def _outcome(word: str, outcome: Outcome) -> Words:
    named = Words(word)
    named.words = outcome.value
    return named


@cache
def names(protocol: Protocol) -> dict[str, Any]:
    """Return what placeholders stand for; the lists are what `each` of a row may go over."""

    def named(specs: Any) -> list[Instruction]:
        return [_instruction(protocol, spec) for spec in specs]

    timing, motions = protocol.timing, list(moving_motions(protocol))
    found: dict[str, Any] = {
        "answer": {word: protocol.answers[outcome].name for word, outcome in OUTCOMES.items()},
        "code": {word: protocol.answers[outcome].code for word, outcome in OUTCOMES.items()},
        "unused_code": next(code for code in range(256) if code not in protocol.codes),
        "after_codes": max(protocol.codes) + 1,
        "outcomes": [_outcome(w, o) for w, o in OUTCOMES.items() if o is not Outcome.VALID],
        "responses": protocol.responses,
        "motions": motions,
        "measured_motion": min(motions, default=""),
        "other_motions": [motion for motion in motions if motion is not min(motions)],
        "movers": named(movers(protocol)),
        "moving": named(s for s in protocol.instructions if s.effect.motion in motions),
        "setters": named(setters(protocol)),
        "setting": {variable_of(s): _instruction(protocol, s) for s in setters(protocol)[::-1]},
        "steering": named(s for s in setters(protocol) if variable_of(s) == "steering"),
        "instructions": named(protocol.instructions),
        "stop": _instruction(protocol, protocol.stop),
        "unused": protocol.unused_ids,
        "longest": protocol.data_lengths[-1],
        "top": {variable: high for variable, (_, high) in protocol.limits.items()},
        "half_speed": protocol.limits.get("speed", (0, 0))[1] // 2,
        "some": _some(protocol),
        "timeout": int(timing.truncation_timeout),
        "late_answer": 1.2 * timing.answer_longest,
        "late_stop": 3 * timing.stop_longest,
    }
    lit = [s for s in protocol.instructions if any(part.bits for part in s.fields)]
    if lit:
        found["lit"] = _instruction(protocol, lit[0])
    if motions:
        found["last_motion"] = motions[-1]
    if protocol.unused_ids:
        found["last_unused"] = protocol.unused_ids[-1]
    for spec in lit:
        if list(bad_data(spec)):
            found["bits"] = _instruction(protocol, spec)
    if protocol.instructions[-1].effect.assignments:
        found["last"] = _instruction(protocol, protocol.instructions[-1])
    return found


def _some(protocol: Protocol) -> dict[str, int]:
    """Return a value for each variable that it does not have at power-on, where it has others."""
    low, high = protocol.limits.get("speed", (0, 0))
    return {
        "speed": (low + high) // 3,
        "led": protocol.limits.get("led", (0, 0))[1],
        "steering": protocol.limits.get("steering", (0, 0))[1] // 12,
    }
