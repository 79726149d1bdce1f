"""Open points of the document (PICS), and the choices that a device can make and must keep to.

Each point belongs to a reading (`spec.readings`); its first choice is the kit's default. A device
that shows another choice everywhere gets that choice's verdict, one that shows two fails.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.protocol import Protocol


@dataclass(frozen=True, slots=True)
class Choice:
    """One way to read an open point.

    `verdict` is what a device gets that always makes this choice; `option` is the word for
    `--allow` without which the device fails, "" if none is needed.
    """

    word: str
    verdict: Verdict
    option: str = ""


@dataclass(frozen=True, slots=True)
class OpenPoint:
    """An open point: its id (a reading, or a part of one), and its choices, the default first."""

    id: str
    choices: tuple[Choice, ...]

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


def _point(
    ident: str, default: str, *others: tuple[str, Verdict] | tuple[str, Verdict, str]
) -> OpenPoint:
    choices = (Choice(default, Verdict.PASS), *(Choice(*other) for other in others))
    return OpenPoint(ident, choices)


_INFO, _OTHER = Verdict.INFORMATIONAL, Verdict.NON_STRICT

POINTS: dict[str, OpenPoint] = {
    point.id: point
    for point in (
        _point("R-unused-length", "header", ("too-many", _OTHER), ("too-few", _OTHER)),
        _point("R-competing-errors", "length", ("data", _OTHER)),
        _point("R-led-upper-bits", "refused", ("ignored", _OTHER, "led-upper=ignore")),
        _point("R-led-id", "table", ("example", _OTHER, "led-id")),
        _point("R-version", "current", ("older", _OTHER, "version")),
        _point("R-truncated-known", "answered", ("silent", _OTHER)),
        _point(
            "R-truncated-unused",
            "header",
            ("too-few", _OTHER),
            ("too-many", _OTHER),
            ("silent", _OTHER),
        ),
        _point("R-truncated-long", "too-few", ("too-many", _OTHER), ("silent", _OTHER)),
        _point("R-truncation-timeout", "between-bytes", ("whole-frame", _OTHER)),
        _point("R-answer-point", "after-data", ("at-header", _OTHER)),
        _point("R-drain-known", "consumed", ("flushed", _OTHER)),
        _point(
            "R-drain-unused",
            "consumed",
            ("flushed", _OTHER),
            ("run", _OTHER, "unused-length=header-only"),
        ),
        _point("R-pipelining unused-id", "in-order", ("lost-after-fault", _OTHER)),
        _point("R-pipelining too-few", "in-order", ("lost-after-fault", _OTHER)),
        _point("R-pipelining bad-data", "in-order", ("lost-after-fault", _OTHER)),
        _point("R-fault-state speed", "kept", ("zeroed", _INFO)),
        _point("R-fault-state steering", "reset", ("kept", _INFO)),
        _point("R-stop-steering", "reset", ("kept", _OTHER)),
        _point("R-stop-speed", "kept", ("zeroed", _OTHER)),
        _point("R-drive-steering", "kept", ("straight", _INFO)),
        _point("R-steer-rotating", "remembered", ("curve", _INFO)),
        _point("R-speed-moving", "at-once", ("next-motion", _OTHER)),
        _point("R-led-state stop", "unchanged", ("off", _INFO)),
        _point("R-led-state fault", "unchanged", ("off", _INFO)),
        _point("R-watchdog", "drives-on", ("stops", _INFO)),
    )
}


def default_of(point: str) -> str:
    """The kit's own choice of a point, "" for a point that this version does not know."""
    return POINTS[point].default if point in POINTS else ""


STATE_POINTS = (
    "R-fault-state speed",
    "R-fault-state steering",
    "R-stop-steering",
    "R-stop-speed",
    "R-drive-steering",
    "R-steer-rotating",
    "R-speed-moving",
    "R-led-state stop",
    "R-led-state fault",
)
"""The open points about the robot's state after a frame."""


FLUSH_POINTS = (
    "R-drain-known",
    "R-drain-unused",
    "R-pipelining unused-id",
    "R-pipelining too-few",
    "R-pipelining bad-data",
)
"""The open points at which a device may discard what follows a fault."""


@dataclass
class Choices:
    """The choices of one device: for each open point its word, and the case that showed it.

    A point that was never shown counts as the default. `allowed` are the options that were given
    (`led-upper` -> `ignore`), `led_id` the ID that the device uses for the LED where it is not the
    document's. `others` are the points at which the device has chosen otherwise than the kit.
    """

    shown: dict[str, tuple[str, str]] = field(default_factory=dict)
    allowed: dict[str, str] = field(default_factory=dict)
    led_id: int | None = None
    others: set[str] = field(default_factory=set)

    def word(self, point: str) -> str:
        """The device's choice of a point."""
        return self.shown[point][0] if point in self.shown else POINTS[point].default

    def differs(self, point: str) -> bool:
        """Whether the device was seen to choose otherwise than the kit does."""
        return bool(self.others) and point in self.others

    def record(self, point: str, word: str, case: str) -> str:
        """Record that the device showed `word` in `case`.

        The first choice of a point is kept. Returns a sentence if `word` contradicts it, else "".
        """
        before, where = self.shown.setdefault(point, (word, case))
        if before != POINTS[point].default:
            self.others.add(point)
        if before == word:
            return ""
        reading = POINTS[point].reading
        return f"{reading}: {word} here, {before} in {where}; a device keeps to one choice"

    def but(self, point: str, word: str) -> Choices:
        """These choices, but `word` at `point`."""
        default = word == POINTS[point].default
        others = self.others - {point} if default else self.others | {point}
        return replace(self, shown=self.shown | {point: (word, "")}, others=others)

    def verdict(self, point: str) -> Verdict:
        """The verdict of the device's choice of a point."""
        choice = POINTS[point].choice(self.word(point))
        return choice.verdict if choice else Verdict.PASS


_ALLOWED = {
    "led-upper": ("ignore", "the LED ignores the bits that mean nothing"),
    "led-id": ("ID", "the LED has another ID, as in example 5.3"),
    "unused-length": ("header-only", "the data of an unused ID are run as instructions"),
    "pipelining": ("no", "an instruction is sent only when the last was answered"),
    "version": ("VERSION", "an older version of the document, without the LED"),
}


def parse_allowed(protocol: Protocol, texts: Iterable[str]) -> dict[str, str]:
    """The values of `--allow NAME=VALUE`, by name. Raises ValueError, in one sentence."""
    found: dict[str, str] = {}
    for text in texts:
        name, _, value = text.partition("=")
        wanted, _ = _ALLOWED.get(name, ("", ""))
        numbers = [str(i) for i in protocol.unused_ids]
        fits = {
            "ID": value in numbers,
            "VERSION": bool(value) and value != protocol.version,
            "": False,
        }.get(wanted, value == wanted)
        if not fits:
            raise ValueError(f"{text!r} cannot be allowed; there are {allowed_words(protocol)}")
        found[name] = value
    return found


def allowed_words(protocol: Protocol) -> str:
    """The values that `--allow` takes, in words."""
    examples = {"ID": str(next(iter(protocol.unused_ids), 0)), "VERSION": "1.0"}
    words = [f"{name}={examples.get(value, value)}" for name, (value, _) in _ALLOWED.items()]
    return ", ".join(words)
