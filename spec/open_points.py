"""Open points of the document (PICS), as data: the choices that a device can make and must keep to.

Each point belongs to a reading (`spec.readings`), which says it in words and gives the verdict of
its other choices. The suite's accepted answers, its model of the state, the experiments that find
out a device's choices, `--allow` and the simulated devices that choose otherwise read this table.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache
from typing import NamedTuple

from bilprov.spec.codec import Judgement
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Effect, Moment
from bilprov.spec.protocol import Protocol

SILENCE_READING = "R-truncated-known"
"""The reading that lets a device stop at a truncated frame without an answer."""


class Behaviour(StrEnum):
    """What a device does that makes a choice, other than to answer."""

    SILENT = "silent"
    KEPT = "kept"
    RESET = "reset"
    DISCARDED = "discarded"


@dataclass(frozen=True, slots=True)
class Choice:
    """One way to read an open point.

    `word` names it in reports and profiles. `does` is the outcome that is answered, or another
    behaviour; None where an experiment of its own tells it. `option` is the value of `--allow`
    without which such a device fails; the grammar limits a value in capitals.
    """

    word: str
    does: Outcome | Behaviour | None = None
    option: str = ""


@dataclass(frozen=True, slots=True)
class OpenPoint:
    """An open point: its id (a reading, or a part of one), and its choices, the default first.

    A point about the state is about one `variable`, after frames of these `moments`. `skipped` is
    the value of `--allow` with which it is not tested, "" where there is none.
    """

    id: str
    choices: tuple[Choice, ...]
    variable: str = ""
    moments: tuple[Moment, ...] = ()
    skipped: str = ""

    @property
    def reading(self) -> str:
        """The reading that the point belongs to."""
        return self.id.partition(" ")[0]

    @property
    def default(self) -> str:
        """The word of the kit's own choice."""
        return self.choices[0].word

    def choice(self, word: str) -> Choice | None:
        """The choice of that word, None if the point has no such choice."""
        return next((choice for choice in self.choices if choice.word == word), None)

    def word_of(self, seen: str) -> str:
        """The word of the choice with this behaviour; what was seen itself, if there is none."""
        return next((choice.word for choice in self.choices if choice.does == seen), seen)


def _point(
    ident: str, default: Choice | str, *others: Choice, on: tuple[str, *tuple[Moment, ...]] = ("",)
) -> OpenPoint:
    first = default if isinstance(default, Choice) else Choice(default)
    variable, *moments = on
    return OpenPoint(ident, (first, *others), variable, tuple(moments))


_TOO_MANY, _TOO_FEW = Choice("too-many", Outcome.TOO_MANY), Choice("too-few", Outcome.TOO_FEW)
_SILENT = Choice("silent", Behaviour.SILENT)
_FLUSHED = Choice("flushed", Behaviour.DISCARDED)
_LOST = Choice("lost-after-fault", Behaviour.DISCARDED)
_KEPT, _UNCHANGED = (Choice(word, Behaviour.KEPT) for word in ("kept", "unchanged"))
_RESET, _ZEROED, _STRAIGHT, _OFF = (
    Choice(word, Behaviour.RESET) for word in ("reset", "zeroed", "straight", "off")
)

POINTS: dict[str, OpenPoint] = {
    point.id: point
    for point in (
        _point("R-unused-length", "header", _TOO_MANY, _TOO_FEW),
        _point("R-competing-errors", "length", Choice("data", Outcome.BAD_DATA)),
        _point(
            "R-led-upper-bits",
            Choice("refused", Outcome.BAD_DATA),
            Choice("ignored", Outcome.VALID, "led-upper=ignore"),
        ),
        _point("R-led-id", "table", Choice("example", option="led-id=ID")),
        _point("R-truncated-known", "answered", _SILENT),
        _point("R-truncated-unused", "header", _TOO_FEW, _TOO_MANY, _SILENT),
        _point("R-truncated-long", "too-few", _TOO_MANY, _SILENT),
        _point("R-truncation-timeout", "between-bytes", Choice("whole-frame")),
        _point("R-answer-point", "after-data", Choice("at-header")),
        _point("R-drain-known", "consumed", _FLUSHED),
        _point(
            "R-drain-unused",
            "consumed",
            _FLUSHED,
            Choice("run", option="unused-length=header-only"),
        ),
        *(
            replace(_point(f"R-pipelining {kind}", "in-order", _LOST), skipped="pipelining=no")
            for kind in ("unused-id", "too-few", "bad-data")
        ),
        _point("R-fault-state speed", _KEPT, _ZEROED, on=("speed", Moment.FAULT)),
        _point("R-fault-state steering", _RESET, _KEPT, on=("steering", Moment.FAULT)),
        _point("R-stop-steering", _RESET, _KEPT, on=("steering", Moment.STOP)),
        _point("R-stop-speed", _KEPT, _ZEROED, on=("speed", Moment.STOP)),
        _point("R-drive-steering", _KEPT, _STRAIGHT, on=("steering", Moment.DRIVE)),
        _point("R-rotate-steering", _KEPT, _RESET, on=("steering", Moment.ROTATION)),
        _point("R-steer-rotating", "remembered", Choice("curve"), on=("steering", Moment.SETTING)),
        _point("R-speed-moving", "at-once", Choice("next-motion"), on=("speed", Moment.SETTING)),
        _point("R-led-state stop", _UNCHANGED, _OFF, on=("led", Moment.STOP)),
        _point("R-led-state fault", _UNCHANGED, _OFF, on=("led", Moment.FAULT)),
        _point("R-watchdog", "drives-on", Choice("stops")),
        _point(
            "R-version",
            Choice("current", Outcome.VALID),
            Choice("older", Outcome.UNKNOWN_ID, "version=VERSION"),
        ),
    )
}

SPLIT = {("R-drive-steering", "straight"): ("R-rotate-steering", "reset")}
"""Choices that meant another one too, before their point was split: older profiles hold them."""

STATE_POINTS = tuple(ident for ident, point in POINTS.items() if point.variable)
"""The open points about the robot's state after a frame."""

FLUSH_POINTS = tuple(
    ident
    for ident, point in POINTS.items()
    if any(choice.does is Behaviour.DISCARDED for choice in point.choices)
)
"""The open points at which a device may discard what follows a fault."""


@cache
def points_after(moment: Moment) -> dict[str, OpenPoint]:
    """The open points about the state after frames of a kind, by variable."""
    return {point.variable: point for point in POINTS.values() if moment in point.moments}


@cache
def open_after(effect: Effect, moment: Moment) -> dict[str, OpenPoint]:
    """The open points about the state after frames of a kind that have this effect, by variable.

    A point is open where the grammar says what the kit's own choice does. A grammar whose effect is
    another has decided the point, and a device is held to it.
    """
    given = dict(effect.assignments)
    own = {Behaviour.KEPT: None, Behaviour.RESET: 0}
    return {
        variable: point
        for variable, point in points_after(moment).items()
        if point.choices[0].does in own and given.get(variable) == own[point.choices[0].does]
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
