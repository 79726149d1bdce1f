"""The output of a device after one input: its answers, and what the probe then sees."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from bilprov.captures.schemas import Look
from bilprov.conformance.oracle.wording import answer_words
from bilprov.spec.motion import WHEELS, Motion
from bilprov.spec.protocol import Protocol

FACETS = {"moving": "whether it moves", "motion": "its motion", "ahead": "its wheels", "led": "led"}
"""What a look can show, by the facet of an output, in words."""
_MOTIONS = {signs: motion.value for motion, signs in WHEELS.items()}


class Output(NamedTuple):
    """Answer codes, and the facets of a look; None is what is not seen or, if expected, not known.

    `motion` is the kind of motion, `ahead` the wheel that turns faster in a drive (`left`, `right`,
    or `alike`): no mixing law is given, so speeds count by sign and order only.
    """

    codes: tuple[int, ...]
    moving: bool | None = None
    motion: str | None = None
    ahead: str | None = None
    led: int | None = None

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
        return "moving" if self.moving else Motion.STOPPED.value

    @property
    def look_words(self) -> str:
        """The look in few words: `forward, left wheel ahead, led 7`; "" where nothing is seen."""
        ahead = f"{self.ahead} wheel ahead" if self.ahead in ("left", "right") else ""
        led = "" if self.led is None else f"led {self.led}"
        return ", ".join(filter(None, (self.motion_words, ahead, led)))

    def words(self, protocol: Protocol) -> str:
        """The whole output in words: `00 OK; forward, led 0`."""
        return "; ".join(filter(None, (answer_words(protocol, self.codes), self.look_words)))


def output_of(codes: tuple[int, ...], look: Look | None) -> Output:
    """The output for these answers and this look; None where the robot was not looked at."""
    if look is None:
        return Output(codes)
    # A probe may name the direction that is set although speed 0 keeps the wheels still.
    still = look.moving is False and look.motion is not None
    motion, ahead = Motion.STOPPED.value if still else look.motion, None
    if look.left is not None and look.right is not None:
        turning, ahead = _turning(look.left, look.right)
        motion = turning if motion in (None, turning) else f"{motion}, by its wheels {turning}"
    return Output(codes, look.moving, motion, ahead, look.led)


def _turning(left: int, right: int) -> tuple[str, str | None]:
    """The kind of motion that the wheels' speeds show, and in a drive the wheel that is ahead."""
    slow, fast = sorted((abs(left), abs(right)))
    if not fast:
        return Motion.STOPPED.value, None
    if left * right < 0 and 2 * slow >= fast:
        return _MOTIONS[_sign(left), _sign(right)], None
    onward = _sign(left + right)
    ahead = "alike" if slow == fast else "left" if abs(left) == fast else "right"
    return _MOTIONS[onward, onward], ahead


def _sign(value: int) -> int:
    return (value > 0) - (value < 0)
