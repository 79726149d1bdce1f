"""Errata, readings and open points of the source document, as data; verdicts name their ids.

Below them is which points are open after a frame, and which other answers to it are then legal.
Quotations are the document's own Swedish words. Only the errata check (`bilprov.spec.explain`)
computes from these texts: it judges the document's examples by the grammar.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from functools import cache
from typing import NamedTuple

from bilprov.spec.codec import Judgement
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Moment
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import Effect


class Erratum(NamedTuple):
    """A place where the document contradicts itself.

    `example` is (section, line) of the faulty example where there is one, `meant` the bytes that
    the document's own table asks for. `shows` says who can find it: the grammar alone, the
    comparison of the prose with the bytes, or only a reader.
    """

    id: str
    clause: str
    quote: str
    correction: str
    shows: str
    example: tuple[str, int] | None = None
    meant: str = ""


class Behaviour(StrEnum):
    """What a device does that makes a choice, other than to answer."""

    SILENT = "silent"
    KEPT = "kept"
    RESET = "reset"
    DISCARDED = "discarded"


class Choice(NamedTuple):
    """One way to read an open point.

    `word` names it in reports and profiles. `does` is the outcome that is answered, or another
    behaviour; None where an experiment of its own tells it. `option` is the value of `--allow`
    without which such a device fails; the grammar limits a value in capitals.
    """

    word: str
    does: Outcome | Behaviour | None = None
    option: str = ""


class OpenPoint(NamedTuple):
    """An open point: its id (a reading, or a part of one), and its choices, the default first.

    The suite's accepted answers, its model of the state, the experiments that find out a device's
    choices, `--allow` and the simulated devices that choose otherwise read it.

    A point about the state is about one variable, after frames of these `moments`: `about` is
    speed, steering or led, whatever the grammar calls it. `skipped` is the value of `--allow`
    with which it is not tested, "" where there is none.
    """

    id: str
    choices: tuple[Choice, ...]
    about: str = ""
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


class Reading(NamedTuple):
    """A point on which the document is silent: our default, and the verdicts of other choices.

    `others` are pairs of (choice, verdict), the best verdict first. `points` are what a device can
    choose there and must keep to (PICS), where that can be found out.
    """

    id: str
    clause: str
    point: str
    quote: str
    default: str
    others: tuple[tuple[str, str], ...] = ()
    points: tuple[OpenPoint, ...] = ()

    @property
    def verdict(self) -> str:
        """The label of the verdict of a legal other choice, or of one that an option allows."""
        first = self.others[0][1] if self.others else ""
        return first.removeprefix("fail; ").removesuffix(" if allowed")


class Example(NamedTuple):
    """One line of an example: its section, line number, bits as printed, and its comment."""

    section: str
    line: int
    bits: str
    comment: str


EXAMPLES = (
    Example("5.1", 1, "00100000", "Sätt riktning framåt"),
    Example("5.1", 2, "00010001 11111111", "Sätt hastigheten till full styrka (255)"),
    Example("5.2", 1, "00100000", "Sätt riktning framåt"),
    Example("5.2", 2, "01000000 11111111", "Sätt styrriktning höger med full styrka (255)"),
    Example("5.2", 3, "00010001 01111111", "Sätt hastigheten till halv styrka (127)"),
    Example("5.3", 1, "00110000", "Sätt riktning bakåt"),
    Example("5.3", 2, "00010001 01111111", "Sätt hastigheten till halv styrka (127)"),
    Example("5.3", 3, "00000000", "Stanna"),
    Example("5.3", 4, "01110000", "Roterar vänster"),
    Example("5.3", 5, "00000000", "Stanna"),
    Example("5.3", 6, "00100000", "Sätt riktning framåt"),
    Example("5.3", 7, "00010001 11111111", "Sätt hastigheten till full fart (255)"),
    Example("5.3", 8, "10010001 00000010", "Sätt RGB-dioden till grönt."),
)

ERRATA = (
    Erratum(
        "E1",
        "section 2",
        "Se tabell 2 i sektion 4 för detaljerad information.",
        "the length nibble is explained by table 1 in section 3; table 2 lists responses",
        "a reader",
    ),
    Erratum(
        "E2",
        "section 3",
        "instruktion 4 har egentligen inga databyte",
        "table 1 gives instruction 4 one data byte",
        "a reader",
    ),
    Erratum(
        "E3",
        "example 5.2",
        "01000000 11111111",
        "the header announces no data and one byte follows; the table asks for 01000001 11111111",
        "the grammar",
        ("5.2", 2),
        "41 ff",
    ),
    Erratum(
        "E4",
        "example 5.2",
        "För att svänga bakåt [...] 00100000 Sätt riktning framåt",
        "the text turns backward, the bytes and their comment go forward; backward is 00110000",
        "the prose",
        ("5.2", 1),
        "30",
    ),
    Erratum(
        "E5",
        "example 5.3",
        "10010001 00000010",
        "ID 9 is unused and stops the robot; the LED is ID 8: 10000001 00000010",
        "the grammar",
        ("5.3", 8),
        "81 02",
    ),
    Erratum(
        "E6",
        "section 4",
        "stöd för upp till 256 olika felkoder",
        "ID 0 means that all is well, which leaves 255 error codes",
        "a reader",
    ),
)

_SAFETY = "Om en felaktig instruktion mottas stannar roboten omedelbart som en säkerhetsåtgärd."
_STOP = "Stoppar roboten och nollställer inställda riktningar"
_UNUSED = "Oanvända funktionsplatser. Användning av dessa kommer stoppa roboten."
_FEW = "För få byte data mottagna"
_MANY = "För många byte data mottagna"
_ANSWER = "Styrelektroniken svarar med en byte"
_LED = "De sista tre bitarna i databyten styr färgerna i ordningen RGB."
_STEER = "Förflyttar roboten åt höger i tidigare satt hastighet och riktning."


def _points(
    default: Choice | str,
    *others: Choice,
    parts: tuple[str, ...] = ("",),
    on: tuple[str, *tuple[Moment, ...]] = ("",),
    skipped: str = "",
) -> tuple[OpenPoint, ...]:
    """The open points of the parts of a reading; the reading puts its own id before each."""
    first = default if isinstance(default, Choice) else Choice(default)
    about, *moments = on
    choices = (first, *others)
    return tuple(OpenPoint(part, choices, about, tuple(moments), skipped) for part in parts)


_TOO_MANY, _TOO_FEW = Choice("too-many", Outcome.TOO_MANY), Choice("too-few", Outcome.TOO_FEW)
_SILENT = Choice("silent", Behaviour.SILENT)
_FLUSHED = Choice("flushed", Behaviour.DISCARDED)
_LOST = Choice("lost-after-fault", Behaviour.DISCARDED)
_KEPT, _UNCHANGED = (Choice(word, Behaviour.KEPT) for word in ("kept", "unchanged"))
_RESET, _ZEROED, _STRAIGHT, _OFF = (
    Choice(word, Behaviour.RESET) for word in ("reset", "zeroed", "straight", "off")
)

READINGS = (
    Reading(
        "R-unused-length",
        "section 3, table 1",
        "an unused ID with data announced",
        _UNUSED,
        "BAD_HEADER, whatever follows, and stop",
        (("too many or too few, and stop", "non-strict"), ("no stop", "fail")),
        points=_points("header", _TOO_MANY, _TOO_FEW),
    ),
    Reading(
        "R-known-length",
        "section 4, table 2",
        "a known ID with a wrong length",
        f"{_MANY} / {_FEW}",
        "too many or too few, as in table 2",
        (("BAD_HEADER, although the header carries the length", "fail"),),
    ),
    Reading(
        "R-competing-errors",
        "section 4, table 2",
        "too many data bytes, the first of them out of range",
        f"{_MANY} / Felaktig data mottagen",
        "the length is judged first: too many",
        (("bad data", "non-strict"),),
        points=_points("length", Choice("data", Outcome.BAD_DATA)),
    ),
    Reading(
        "R-led-upper-bits",
        "section 3, table 1",
        "LED data with any of the upper bits set",
        _LED,
        "BAD_DATA and stop, the LED unchanged",
        (
            ("ignored: OK, the low bits shown, no stop", "fail; non-strict if allowed"),
            ("OK with stop, BAD_DATA without stop, or only some bits checked", "fail"),
        ),
        points=_points(
            Choice("refused", Outcome.BAD_DATA),
            Choice("ignored", Outcome.VALID, "led-upper=ignore"),
        ),
    ),
    Reading(
        "R-led-id",
        "example 5.3",
        "the example uses an unused ID for the LED",
        "10010001 00000010 Sätt RGB-dioden till grönt.",
        "the ID of table 1",
        (("the example's ID instead", "fail; non-strict if allowed"), ("both", "fail")),
        points=_points("table", Choice("example", option="led-id=ID")),
    ),
    Reading(
        "R-example-right",
        "example 5.2",
        "Right with length 0, then a byte",
        "01000000 11111111 Sätt styrriktning höger med full styrka (255)",
        "too few and stop; the byte is the next header",
        (("swallowing the byte", "fail"),),
    ),
    Reading(
        "R-truncated-known",
        "section 4, table 2",
        "a known instruction whose data do not all arrive",
        _FEW,
        "after a time-out too few and stop",
        (
            ("stop without an answer", "non-strict"),
            ("never times out and keeps driving", "fail"),
        ),
        points=_points("answered", _SILENT),
    ),
    Reading(
        "R-truncated-unused",
        "section 3, table 1",
        "an unused ID whose data do not all arrive",
        _UNUSED,
        "after a time-out BAD_HEADER and stop",
        (("too few", "non-strict"),),
        points=_points("header", _TOO_FEW, _TOO_MANY, _SILENT),
    ),
    Reading(
        "R-truncated-long",
        "section 4, table 2",
        "cut short, and more was announced than allowed",
        f"{_MANY} / {_FEW}",
        "too few",
        (("too many", "non-strict"),),
        points=_points("too-few", _TOO_MANY, _SILENT),
    ),
    Reading(
        "R-truncation-timeout",
        "section 2",
        "how long a frame may pause",
        "hur många efterföljande byte med data som följer efter",
        "not stated; the simulator takes the grammar's time-out between bytes; measured",
        (("outside the grammar's limits, or counted over the whole frame", "non-strict"),),
        points=_points("between-bytes", Choice("whole-frame")),
    ),
    Reading(
        "R-answer-deadline",
        "section 2",
        "how soon the answer comes",
        _ANSWER,
        "within the deadline, the grammar's unless --deadline gives another; measured",
        (("slow, up to the grammar's longest", "non-strict"), ("later, or two answers", "fail")),
    ),
    Reading(
        "R-stop-point",
        "section 2",
        "a frame that is wrong at its header and announces data",
        _SAFETY,
        "may drive until its answer is due; stopping at the header is as good",
        (("driving on after the answer", "as R-stop-latency"),),
    ),
    Reading(
        "R-stop-latency",
        "section 2",
        '"at once"',
        _SAFETY,
        "stopped when the answer has arrived, and stays so",
        (
            ("up to the grammar's longest stop after it", "non-strict"),
            ("later, or moving again by itself", "fail"),
        ),
    ),
    Reading(
        "R-answer-point",
        "section 2",
        "when a faulty frame is answered",
        _ANSWER,
        "after its announced data",
        (
            ("at the header, the data then taken silently, one answer", "non-strict"),
            ("at the header of a frame that may still be valid", "fail"),
        ),
        points=_points("after-data", Choice("at-header")),
    ),
    Reading(
        "R-drain-known",
        "section 2",
        "data after a faulty known header",
        "hur många efterföljande byte med data som följer efter",
        "consumed",
        (("flushed until idle", "non-strict"), ("run as instructions", "fail")),
        points=_points("consumed", _FLUSHED),
    ),
    Reading(
        "R-drain-unused",
        "section 2",
        "data announced by an unused ID",
        "hur många efterföljande byte med data som följer efter",
        "consumed",
        (("flushed", "non-strict"), ("run as instructions", "fail; non-strict if allowed")),
        points=_points("consumed", _FLUSHED, Choice("run", option="unused-length=header-only")),
    ),
    Reading(
        "R-pipelining",
        "section 2",
        "instructions sent before the last answer came",
        _ANSWER,
        "run in order, one answer each",
        (("lost after a fault", "non-strict"), ("reordered or merged", "fail")),
        points=_points(
            "in-order", _LOST, parts=("unused-id", "too-few", "bad-data"), skipped="pipelining=no"
        ),
    ),
    Reading(
        "R-fault-state",
        "section 2",
        "what a fault resets besides motion",
        _SAFETY,
        "the same as Stop; the speed is kept",
        (
            ("speed zeroed, or steering kept", "informational"),
            ("moving again before a motion instruction", "fail"),
        ),
        points=_points(_KEPT, _ZEROED, parts=("speed",), on=("speed", Moment.FAULT))
        + _points(_RESET, _KEPT, parts=("steering",), on=("steering", Moment.FAULT)),
    ),
    Reading(
        "R-stop-steering",
        "section 3, table 1",
        "Stop resets the directions that were set (plural)",
        _STOP,
        "direction and steering",
        (("direction only", "non-strict"),),
        points=_points(_RESET, _KEPT, on=("steering", Moment.STOP)),
    ),
    Reading(
        "R-stop-speed",
        "section 3, table 1",
        "the speed after Stop",
        _STOP,
        "kept (example 5.3 rests on it)",
        (("zeroed", "non-strict"),),
        points=_points(_KEPT, _ZEROED, on=("speed", Moment.STOP)),
    ),
    Reading(
        "R-drive-steering",
        "section 3, table 1",
        "steering when Forward or Backward comes",
        "Sätter färdriktning framåt",
        "kept",
        (("straight", "informational"),),
        points=_points(_KEPT, _STRAIGHT, on=("steering", Moment.DRIVE)),
    ),
    Reading(
        "R-rotate-steering",
        "section 3, table 1",
        "steering when a rotation comes: what a Stop does, or only the wheels",
        "Stannar roboten och roterar",
        "kept",
        (("reset, as by Stop", "informational"),),
        points=_points(_KEPT, _RESET, on=("steering", Moment.ROTATION)),
    ),
    Reading(
        "R-resolution",
        "section 3, table 1",
        "wheel speeds, where the probe shows them, at some speeds and strengths",
        "Datavärde mellan 0-255.",
        "no wheel slower at a higher speed, half slower than full; the wheels never differ less at "
        "a higher strength",
        (
            ("unlike when straight, or left and right not mirrored", "informational"),
            ("a plateau or a dead zone elsewhere", "non-strict"),
            (
                "half as fast as full, order or sign reversed, by the spread and 5 % or 3 steps",
                "fail",
            ),
        ),
    ),
    Reading(
        "R-steering",
        "section 3, table 1",
        "Right after Left; strength 0; steering while stopped",
        _STEER,
        "the last one counts; straight on; remembered without moving",
        (("moving", "fail"),),
    ),
    Reading(
        "R-steer-rotating",
        "section 3, table 1",
        "Right or Left during a rotation",
        _STEER,
        "remembered, goes on rotating",
        (("becomes a curve", "informational"), ("stops", "fail")),
        points=_points("remembered", Choice("curve"), on=("steering", Moment.SETTING)),
    ),
    Reading(
        "R-speed-moving",
        "section 3, table 1",
        "Speed while moving",
        "Används i samband med de övriga instruktionerna.",
        "takes effect at once (example 5.1 rests on it)",
        (("only at the next motion instruction", "non-strict"),),
        points=_points("at-once", Choice("next-motion"), on=("speed", Moment.SETTING)),
    ),
    Reading(
        "R-speed-zero",
        "section 3, table 1",
        "a direction with speed 0",
        "Datavärde mellan 0-255.",
        "accepted, not moving",
    ),
    Reading(
        "R-led-state",
        "section 3, table 1",
        "the LED after Stop or a fault",
        _SAFETY,
        "unchanged",
        (("off", "informational"),),
        points=_points(_UNCHANGED, _OFF, parts=("stop",), on=("led", Moment.STOP))
        + _points(_UNCHANGED, _OFF, parts=("fault",), on=("led", Moment.FAULT)),
    ),
    Reading(
        "R-power-on",
        "section 2",
        "the state at power-on",
        "",
        "stopped, speed 0",
        (("another speed", "informational"), ("moving", "fail")),
    ),
    Reading(
        "R-unsolicited",
        "section 4, table 2",
        "bytes without an instruction",
        "efter en mottagen instruktion",
        "none",
        (("a banner before the first instruction", "informational"), ("later", "fail")),
    ),
    Reading(
        "R-watchdog",
        "section 3, table 1",
        "a silent line while the car drives",
        "",
        "keeps driving",
        (("stops by itself", "informational"), ("resumes by itself", "fail")),
        points=_points("drives-on", Choice("stops")),
    ),
    Reading(
        "R-version",
        "version history",
        "the LED came with v1.1",
        "Ny instruktion för LED-styrning",
        "v1.1",
        (("its ID is unused, as in v1.0", "fail; non-strict if allowed"),),
        points=_points(
            Choice("current", Outcome.VALID), Choice("older", Outcome.UNKNOWN_ID, "version=VERSION")
        ),
    ),
    Reading(
        "R-line",
        "section 1",
        "baud rate, parity, flow control",
        "",
        "as the grammar's line defaults unless given, raw 8 bits",
        (("XON/XOFF or a cooked terminal: XON is the header of Speed", "fail"),),
    ),
)

POINTS = {
    ident: point._replace(id=ident)
    for reading in READINGS
    for point in reading.points
    for ident in [f"{reading.id} {point.id}".strip()]
}
"""The open points by id."""

STATE_POINTS = tuple(ident for ident, point in POINTS.items() if point.about)
"""The open points about the robot's state after a frame."""

FLUSH_POINTS = tuple(
    ident
    for ident, point in POINTS.items()
    if any(choice.does is Behaviour.DISCARDED for choice in point.choices)
)
"""The open points at which a device may discard what follows a fault."""

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
