"""The choices of one device at the open points (`spec.readings`), and those that are allowed.

A device that shows another choice than the default everywhere gets the verdict of the point's
reading (`spec.readings`), one that shows two choices fails.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from bilprov.conformance.oracle.verdicts import LABELS, Verdict
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS, READINGS

_VERDICTS = {reading.id: LABELS.get(reading.verdict, Verdict.FAIL) for reading in READINGS}


def default_of(point: str) -> str:
    """The kit's own choice of a point, "" for a point that this version does not know."""
    return POINTS[point].default if point in POINTS else ""


@dataclass
class Choices:
    """The choices of one device: for each open point its word, and the case that showed it.

    A point that was never shown counts as the default. `allowed` are the options that were given
    (`led-upper` -> `ignore`), `led_id` the ID that the device uses for the LED where it is not the
    document's. `others` are the points at which the device has chosen otherwise than the kit,
    `hidden` those at which the probe did not show its choice.
    """

    shown: dict[str, tuple[str, str]] = field(default_factory=dict)
    allowed: dict[str, str] = field(default_factory=dict)
    led_id: int | None = None
    others: set[str] = field(default_factory=set)
    hidden: set[str] = field(default_factory=set)

    def word(self, point: str) -> str:
        """The device's choice of a point."""
        return self.shown[point][0] if point in self.shown else POINTS[point].default

    def differs(self, point: str) -> bool:
        """Whether the device was seen to choose otherwise than the kit does."""
        return bool(self.others) and point in self.others

    def unknown(self, point: str) -> bool:
        """Whether the device may choose either way at this point: the probe did not show it."""
        return point in self.hidden and point not in self.shown

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
        return verdict_of(point, self.word(point))


def verdict_of(point: str, word: str) -> Verdict:
    """The verdict of a device that always makes this choice."""
    if word == POINTS[point].default:
        return Verdict.PASS
    return _VERDICTS[POINTS[point].reading]


_OPTIONS = (
    option.partition("=")
    for point in POINTS.values()
    for option in (*(choice.option for choice in point.choices), point.skipped)
)
_ALLOWED = {name: value for name, _, value in _OPTIONS if name}


def parse_allowed(protocol: Protocol, texts: Iterable[str]) -> dict[str, str]:
    """The values of `--allow NAME=VALUE`, by name. Raises ValueError, in one sentence."""
    found: dict[str, str] = {}
    for text in texts:
        name, _, value = text.partition("=")
        wanted = _ALLOWED.get(name, "")
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
    words = [f"{name}={examples.get(value, value)}" for name, value in _ALLOWED.items()]
    return ", ".join(words)
