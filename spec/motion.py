"""What a car declares: the variables of its motion, and how its wheels turn."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, NamedTuple

from msgspec import Meta

from bilprov.spec.errors import Declared
from bilprov.spec.state import Effect, State


class Motion(StrEnum):
    """The words of the robot car's motion, as grammars import them that do not declare a state."""

    STOPPED = "stopped"
    FORWARD = "forward"
    BACKWARD = "backward"
    ROTATE_RIGHT = "rotate_right"
    ROTATE_LEFT = "rotate_left"


class Moment(StrEnum):
    """The kinds of frames by what they do to the motion; a setting leaves it as it is."""

    FAULT = "fault"
    STOP = "stop"
    DRIVE = "drive"
    ROTATION = "rotation"
    SETTING = "setting"


MOTIONS = (Moment.DRIVE, Moment.ROTATION)


Turn = Annotated[int, Meta(ge=-1, le=1)]


class Drive(NamedTuple):
    """How a car drives, or is set to: a kind of motion, its speed, its steering (right positive).

    Of a look each is None where the probe does not tell it.
    """

    motion: Any
    speed: Any
    steering: Any


class Wheels(Declared, frozen=True, kw_only=True, dict=True):
    """The declaration of a car with two wheels, which is steered by their speeds.

    `by` is the variable whose words are the kinds of motion: `turns` has how the wheels (left,
    right) turn in each of them, 1 for forward and -1 for backward; in the others they stand still,
    and `still` is the first of these. `speed` and `steering` (right positive) are the variables of
    how fast.
    """

    by: str
    speed: str
    steering: str
    turns: Mapping[str, tuple[Turn, Turn]]
    still: str = ""

    def __hash__(self) -> int:
        return hash((self.by, self.speed, self.steering, self.still, *self.turns))

    def drive(self, values: Any) -> Drive:
        """The values of a state, or of a look, by what they are for."""
        return Drive(
            getattr(values, self.by), getattr(values, self.speed), getattr(values, self.steering)
        )

    def turn(self, motion: str) -> tuple[int, int]:
        """How the wheels (left, right) turn in a kind of motion; 0 where they stand still."""
        return self.turns.get(motion, (0, 0))

    def motion(self, effect: Effect) -> str | None:
        """The kind of motion that an instruction sets, None if it leaves it."""
        return effect.constants.get(self.by)  # type: ignore[return-value]

    def moves(self, effect: Effect) -> bool:
        """Whether an instruction sets the car moving."""
        return self.motion(effect) in self.turns

    def rotates(self, motion: str) -> bool:
        """Whether a kind of motion turns the wheels against each other."""
        left, right = self.turn(motion)
        return left != right

    def moment(self, effect: Effect | None) -> Moment:
        """The kind of a frame by its instruction's effect, None for a faulty frame."""
        if effect is None:
            return Moment.FAULT
        motion = self.motion(effect)
        if motion is None or motion not in self.turns:
            return Moment.SETTING if motion is None else Moment.STOP
        return Moment.ROTATION if self.rotates(motion) else Moment.DRIVE

    def wheels(self, state: State, full_steering: int) -> tuple[int, int]:
        """The wheel speeds (left, right) of the reference robot, forward positive.

        The document gives no mixing law: the reference slows the inner wheel in proportion to the
        steering (at `full_steering` it stands still), and does not steer while it rotates. A test
        may therefore judge only the signs and which wheel is faster.
        """
        motion, speed, steering = self.drive(state)
        left, right = self.turn(motion) if state.moving else (0, 0)
        inner = speed
        if left == right and full_steering:
            inner = speed * (full_steering - abs(steering)) // full_steering
        return left * (inner if steering < 0 else speed), right * (inner if steering > 0 else speed)


def visible_motion(state: State) -> str:
    """The kind of motion of a car that can be seen: it stands still unless the wheels turn."""
    car: Wheels = state.wheels
    return car.drive(state).motion if state.moving else car.still
