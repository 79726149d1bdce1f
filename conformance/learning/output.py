"""The output of a device after one input: its answers, and what the probe then sees."""

from __future__ import annotations

from typing import NamedTuple

from bilprov.captures.schemas import Look
from bilprov.conformance.oracle.wording import answer_words
from bilprov.spec.motion import WHEELS, Motion
from bilprov.spec.protocol import Protocol


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
        return self.codes == other.codes and all(
            mine is None or theirs is None or mine == theirs
            for mine, theirs in zip(self[1:], other[1:], strict=True)
        )

    def beside(self, other: Output) -> Output:
        """This output with only those facets that the other has too."""
        return Output(
            self.codes,
            None if other.moving is None else self.moving,
            None if other.motion is None else self.motion,
            None if other.ahead is None else self.ahead,
            None if other.led is None else self.led,
        )

    @property
    def look(self) -> tuple[bool | None, str | None, str | None, int | None]:
        """The facets of the look."""
        return self.moving, self.motion, self.ahead, self.led

    @property
    def motion_words(self) -> str:
        """The kind of motion, else whether it moves: `forward`, `moving`; "" where not seen."""
        if self.motion or self.moving is None:
            return self.motion or ""
        return "moving" if self.moving else Motion.STOPPED.value

    @property
    def look_words(self) -> str:
        """The look in few words: `forward, left wheel ahead, led 7`; "" where nothing is seen."""
        words = [self.motion_words] if self.motion_words else []
        if self.ahead in ("left", "right"):
            words.append(f"{self.ahead} wheel ahead")
        if self.led is not None:
            words.append(f"led {self.led}")
        return ", ".join(words)

    def words(self, protocol: Protocol) -> str:
        """The whole output in words: `00 OK; forward, led 0`."""
        look = self.look_words
        return answer_words(protocol, self.codes) + (f"; {look}" if look else "")


def output_of(codes: tuple[int, ...], look: Look | None) -> Output:
    """The output for these answers and this look; None where the robot was not looked at."""
    if look is None:
        return Output(codes)
    # A probe may name the direction that is set although speed 0 keeps the wheels still.
    still = look.moving is False and look.motion is not None
    motion, ahead = Motion.STOPPED.value if still else look.motion, None
    if look.left is not None and look.right is not None:
        turning, ahead = _turning(look.left, look.right)
        agree = motion in (None, turning)
        motion = turning if agree else f"{motion}, by its wheels {turning}"
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


_MOTIONS = {signs: motion.value for motion, signs in WHEELS.items()}
