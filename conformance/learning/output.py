"""The output of a device after one input: its answers, and what the probe then sees."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from bilprov.captures.schemas import Look
from bilprov.conformance.oracle.wording import answer_words
from bilprov.spec.motion import Wheels
from bilprov.spec.protocol import Protocol

FACETS = ("moving", "motion", "ahead", "lights")
"""What a look can show, each a facet of an output."""


def facet_words(protocol: Protocol, facet: str) -> str:
    """What a facet tells, in words."""
    known = {"moving": "whether it moves", "motion": "its motion", "ahead": "its wheels"}
    return known.get(facet, " and ".join(protocol.lights))


class Output(NamedTuple):
    """Answer codes, and the facets of a look; None is what is not seen or, if expected, not known.

    `motion` is the kind of motion, `ahead` the wheel that turns faster in a drive (`left`, `right`,
    or `alike`): no mixing law is given, so speeds count by sign and order only. `lights` are the
    values that do not change how it drives, by name.
    """

    codes: tuple[int, ...]
    moving: bool | None = None
    motion: str | None = None
    ahead: str | None = None
    lights: tuple[tuple[str, int], ...] | None = None

    def fits(self, other: Output) -> bool:
        """Whether both are equal in their answers and in every facet that both have."""
        return self == other or self.beside(other) == other.beside(self)

    def beside(self, other: Output) -> Output:
        """This output with only those facets that the other has too."""
        return self.without(name for name in FACETS if getattr(other, name) is None)

    def without(self, facets: Iterable[str]) -> Output:
        """This output with these facets not seen."""
        return self._replace(**dict.fromkeys(facets))  # type: ignore[arg-type]  # each may be None

    @property
    def motion_words(self) -> str:
        """The kind of motion, else whether it moves: `forward`, `moving`; "" where not seen."""
        if self.motion or self.moving is None:
            return self.motion or ""
        return "moving" if self.moving else "stopped"

    @property
    def look_words(self) -> str:
        """The look in few words: `forward, left wheel ahead, led 7`; "" where nothing is seen."""
        ahead = f"{self.ahead} wheel ahead" if self.ahead in ("left", "right") else ""
        lights = (f"{name} {value}" for name, value in self.lights or ())
        return ", ".join(filter(None, (self.motion_words, ahead, *lights)))

    def words(self, protocol: Protocol) -> str:
        """The whole output in words: `00 OK; forward, led 0`."""
        return "; ".join(filter(None, (answer_words(protocol, self.codes), self.look_words)))


def output_of(protocol: Protocol, codes: tuple[int, ...], look: Look | None) -> Output:
    """The output for these answers and this look; None where the robot was not looked at."""
    if look is None:
        return Output(codes)
    # A probe may name the direction that is set although speed 0 keeps the wheels still.
    car = protocol.car
    motion, ahead = car.drive(look).motion, None
    if look.moving is False and motion is not None:
        motion = car.still
    if look.left is not None and look.right is not None:
        turning, ahead = _turning(car, look.left, look.right)
        motion = turning if motion in (None, turning) else f"{motion}, by its wheels {turning}"
    lights = ((name, getattr(look, name)) for name in protocol.lights)
    shown = tuple((name, value) for name, value in lights if value is not None)
    return Output(codes, look.moving, motion, ahead, shown or None)


def _turning(car: Wheels, left: int, right: int) -> tuple[str, str | None]:
    """The kind of motion that the wheels' speeds show, and in a drive the wheel that is ahead."""
    motions = {both: motion for motion, both in car.turns.items()}
    slow, fast = sorted((abs(left), abs(right)))
    if not fast:
        return car.still, None
    turning, onward = (_sign(left), _sign(right)), (_sign(left + right),) * 2
    if left * right < 0 and 2 * slow >= fast:
        return motions.get(turning, "moving"), None
    ahead = "alike" if slow == fast else "left" if abs(left) == fast else "right"
    return motions.get(onward, "moving"), ahead


def _sign(value: int) -> int:
    return (value > 0) - (value < 0)
