"""Triggers: the frames at which a device misbehaves, as text in a few words.

A trigger is terms separated by commas, all of which must hold: `faulty, moves backward, row >= 2`.
A term is a subject alone (it must not be 0 or empty), a subject and values (it must have one of
them), or a subject, an operator and a value. The subjects are the keys of `FRAME`, `STATE`,
`HISTORY`, and `times`: how often the terms before it held before.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any, NamedTuple

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.simulator import Event
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Moment, visible_motion
from bilprov.spec.readings import open_point, points_after
from bilprov.spec.state import Effect

Subject = Callable[[Event], Any]

# The first five are those that a frame of a header and data can have.
OUTCOMES = {outcome.name.lower().replace("_", "-"): outcome for outcome in tuple(Outcome)[:5]}
"""Outcomes by the word that names them in triggers, effects and names of faults: `too-few`."""
OUTCOME_WORDS = {outcome: word for word, outcome in OUTCOMES.items()}
TRUNCATED = "truncated"


def _byte(index: int) -> Subject:
    return lambda e: e.judgement.frame[index] if len(e.judgement.frame) > abs(index) else None


def _value(event: Event) -> int | None:
    """The value of the first field, None where no data were decoded."""
    fields = event.judgement.fields
    return fields[0][1] if fields else None


def _meaningless(event: Event) -> int | None:
    """The bits of the first field that mean nothing."""
    known, value = event.judgement.instruction, _value(event)
    return None if known is None or value is None else value & ~known.fields[0].high


def _has_bits(event: Event) -> bool:
    """Whether the instruction has data whose bits have names."""
    known = event.judgement.instruction
    return known is not None and any(part.bits for part in known.fields)


def _excess(event: Event) -> int:
    """How many data bytes a known ID has too many by its header."""
    known = event.judgement.instruction
    return event.judgement.length - known.length if known else 0


def _effect(event: Event) -> Effect | None:
    """The effect of a valid frame, None for a faulty one."""
    known = event.judgement.instruction
    return known.effect if known and event.judgement.valid else None


def _set_motion(event: Event) -> str:
    """The motion that a valid frame sets, "" for none."""
    return event.protocol.car.motion(_effect(event) or Effect()) or ""


def moment(event: Event) -> Moment:
    """The kind of a frame: faulty, or what its instruction does to the motion."""
    return event.protocol.car.moment(_effect(event))


def _turns(event: Event) -> bool:
    """Whether a valid frame sets another motion than that before it."""
    motion, car = _set_motion(event), event.protocol.car
    return motion in car.turns and motion != car.drive(event.before).motion


def _before(variable: str) -> Subject:
    """The value of a variable before a frame, None where the protocol has none of that role."""

    def value(event: Event) -> Any:
        name = event.protocol.by_role.get(variable)
        return None if name is None else getattr(event.before, name)

    return value


def _sets(event: Event) -> tuple[str, ...]:
    """The variables that a valid frame sets which leaves the motion alone."""
    effect = _effect(event)
    if effect is None or moment(event) is not Moment.SETTING:
        return ()
    return tuple(event.protocol.role_of[name] for name, _ in effect.assignments)


def _open(event: Event) -> tuple[str, ...]:
    """The open points that a frame touches; a colon stands for the blank in an id."""
    after = (point.id for point in points_after(moment(event)))
    return tuple(point.replace(" ", ":") for point in (open_point(event.judgement), *after))


FRAME: dict[str, Subject] = {
    "valid": lambda e: e.judgement.valid,
    "faulty": lambda e: not e.judgement.valid,
    "whole": lambda e: e.kind == "instruction",
    TRUNCATED: lambda e: e.kind == "truncated",
    "outcome": lambda e: TRUNCATED if e.kind == TRUNCATED else OUTCOME_WORDS[e.judgement.outcome],
    "fault": lambda e: "" if e.judgement.valid else OUTCOME_WORDS[e.judgement.outcome],
    "instruction": lambda e: e.judgement.name if e.judgement.valid else "",
    "name": lambda e: e.judgement.name,
    "has-bits": _has_bits,
    "known": lambda e: e.judgement.instruction is not None,
    "id": lambda e: e.judgement.id,
    "length": lambda e: e.judgement.length,
    "excess": _excess,
    "size": lambda e: len(e.judgement.frame),
    "first-byte": _byte(1),
    "second-byte": _byte(2),
    "last-byte": _byte(-1),
    "value": _value,
    "meaningless-bits": _meaningless,
    "sets": _sets,
    "sets-motion": _set_motion,
    "turns": _turns,
    "open": _open,
}
STATE: dict[str, Subject] = {
    "moves": lambda e: visible_motion(e.before),
    "rotates": lambda e: e.protocol.car.rotates(e.protocol.car.drive(e.before).motion),
    **{variable: _before(variable) for variable in ("motion", "speed", "steering", "led")},
    "pipelined": lambda e: e.pipelined,
    "pause": lambda e: e.pause / MS,
    "gap": lambda e: None if e.gap is None else e.gap / MS,
}


def _previous(event: Event) -> str:
    """The instruction of the frame before, or its outcome where it was faulty."""
    before = event.previous
    if before is None:
        return ""
    return before.name if before.valid else OUTCOME_WORDS[before.outcome]


HISTORY: dict[str, Subject] = {
    "previous": _previous,
    "after-truncated": lambda e: e.previous_kind == TRUNCATED,
    "frames": lambda e: e.frames,
    "faults": lambda e: e.faults,
    "truncated-frames": lambda e: e.truncated,
    "row": lambda e: e.row,
}
SUBJECTS = FRAME | STATE | HISTORY

OPERATORS: dict[str, Callable[[Any, tuple[Any, ...]], bool]] = {
    "": lambda subject, _: bool(subject),
    "==": lambda subject, values: any(one in values for one in _each(subject)),
    "!=": lambda subject, values: subject not in values,
    "<": lambda subject, values: subject < values[0],
    ">": lambda subject, values: subject > values[0],
    ">=": lambda subject, values: subject >= values[0],
    "&": lambda subject, values: subject & values[0] != 0,
    "!&": lambda subject, values: subject & values[0] == 0,
    "every": lambda subject, values: subject % values[0] == values[0] - 1,
}


def _each(subject: Any) -> tuple[Any, ...]:
    return subject if isinstance(subject, tuple) else (subject,)


class Term(NamedTuple):
    """One term: what is compared, how, and with which values."""

    subject: str
    operator: str
    values: tuple[Any, ...]

    def holds(self, subject: Any) -> bool:
        """Whether the term holds for this value of its subject."""
        return subject is not None and OPERATORS[self.operator](subject, self.values)

    def of(self, event: Event) -> Any:
        """The value of the subject."""
        return SUBJECTS[self.subject](event)


class Trigger(NamedTuple):
    """A condition on frames: `terms`, from a frame of `since` until one of `until`, both included.

    `memory` of the methods is what a device remembers, each trigger under its `text`.
    """

    terms: tuple[Term, ...]
    text: str
    since: Trigger | None = None
    until: Trigger | None = None

    def holds(self, event: Event, memory: dict[str, int]) -> bool:
        """Whether the device misbehaves at this frame."""
        if self.since is None:
            return self._terms_hold(event, memory)
        if self.since.holds(event, memory):
            memory[f"since {self.text}"] = 1
        active = f"since {self.text}" in memory and self._terms_hold(event, memory)
        if self.until is not None and self.until.holds(event, memory):
            memory.pop(f"since {self.text}", None)
        return active

    def _terms_hold(self, event: Event, memory: dict[str, int]) -> bool:
        for term in self.terms:
            if term.subject == "times":
                count = memory.get(f"times {self.text}", 0)
                memory[f"times {self.text}"] = count + 1
                if not term.holds(count):
                    return False
            elif not term.holds(term.of(event)):
                return False
        return True

    @property
    def about_frame(self) -> tuple[Term, ...]:
        """The terms about the frame itself."""
        return tuple(term for term in self.terms if term.subject in FRAME)


@cache
def trigger(when: str, since: str = "", until: str = "") -> Trigger:
    """Return the trigger of this text. Raises ValueError, in one sentence, for an unknown word."""
    terms = tuple(_term(part.split()) for part in when.split(",") if part.strip())
    return Trigger(
        terms,
        f"{when}; {since}; {until}",
        trigger(since) if since else None,
        trigger(until) if until else None,
    )


def _term(words: list[str]) -> Term:
    subject, *rest = words
    if subject != "times" and subject not in SUBJECTS:
        raise ValueError(f"a trigger has no subject {subject!r}")
    operator = "==" if rest else ""
    if rest and rest[0] in OPERATORS:
        operator = rest.pop(0)
    return Term(subject, operator, tuple(number_or_word(word) for word in rest))


def number_or_word(word: str) -> Any:
    """Return a number as such, any other word as it is."""
    if word[-1:].isdigit():
        with suppress(ValueError):
            return int(word) if "." not in word else float(word)
    return word
