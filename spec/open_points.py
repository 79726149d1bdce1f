"""Which points are open after a frame, and which other answers to it are then legal."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

from bilprov.spec.codec import Judgement
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Moment
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS, Behaviour, OpenPoint
from bilprov.spec.state import Effect

SILENCE_READING = "R-truncated-known"
"""The reading that lets a device stop at a truncated frame without an answer."""


@cache
def points_after(moment: Moment) -> tuple[OpenPoint, ...]:
    """The open points about the state after frames of a kind."""
    return tuple(point for point in POINTS.values() if moment in point.moments)


@cache
def open_after(protocol: Protocol, effect: Effect | None) -> dict[str, OpenPoint]:
    """The open points about the state after a frame of this effect, None for a fault, by variable.

    A point is open where the grammar says what the kit's own choice does. A grammar whose effect is
    another has decided the point, and a device is held to it.
    """
    given = dict((effect or protocol.on_fault).assignments)
    own = {Behaviour.KEPT: None, Behaviour.RESET: 0}
    points = ((protocol.by_role.get(p.about), p) for p in points_after(protocol.car.moment(effect)))
    return {
        variable: point
        for variable, point in points
        if variable and point.choices[0].does in own
        if given.get(variable) == own[point.choices[0].does]
    }


class OtherAnswer(NamedTuple):
    """An answer that is legal under another reading; `code` is None for no answer at all.

    `word` is the choice that it shows.
    """

    code: int | None
    reading: str
    word: str


def other_answers(protocol: Protocol, point: str) -> Iterator[OtherAnswer]:
    """Yield the answers of a point's other choices, except of those that an option must allow."""
    for choice in POINTS[point].choices[1:]:
        if choice.does is Behaviour.SILENT:
            yield OtherAnswer(None, SILENCE_READING, choice.word)
        elif isinstance(choice.does, Outcome) and not choice.option:
            code = protocol.answers[choice.does].code
            yield OtherAnswer(code, POINTS[point].reading, choice.word)


def open_point(judgement: Judgement) -> str:
    """Return the open point about the answer to a frame, "" where the document is clear.

    The generators of test cases state the same by rules of their own; a test checks that both
    agree.
    """
    spec = judgement.instruction
    many = judgement.outcome is Outcome.TOO_MANY
    if spec and many and not spec.in_range(judgement.frame[1:]):
        return "R-competing-errors"
    return judgement.reading if judgement.reading in POINTS else ""


def other_choices(protocol: Protocol, judgement: Judgement) -> tuple[OtherAnswer, ...]:
    """Return every answer, except the expected one, that some reading of the document allows."""
    point = open_point(judgement)
    return tuple(other_answers(protocol, point)) if point else ()
