"""The motion state that instructions change, and how the wheels turn in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any


class Motion(StrEnum):
    """The kinds of motion of a two-wheeled car."""

    STOPPED = "stopped"
    FORWARD = "forward"
    BACKWARD = "backward"
    ROTATE_RIGHT = "rotate_right"
    ROTATE_LEFT = "rotate_left"


# The direction in which the wheels (left, right) turn in each kind of motion.
WHEELS = {
    Motion.STOPPED: (0, 0),
    Motion.FORWARD: (1, 1),
    Motion.BACKWARD: (-1, -1),
    Motion.ROTATE_RIGHT: (1, -1),
    Motion.ROTATE_LEFT: (-1, 1),
}


def is_moving(motion: str, speed: int) -> bool:
    """Return whether the wheels turn: a direction with speed 0 does not move (R-speed-zero)."""
    return speed > 0 and motion != Motion.STOPPED


@dataclass(frozen=True, slots=True)
class State:
    """Motion state of the robot: kind of motion, speed, steering (right positive) and LED."""

    motion: Motion = Motion.STOPPED
    speed: int = 0
    steering: int = 0
    led: int = 0

    @property
    def moving(self) -> bool:
        """Whether the wheels turn."""
        return is_moving(self.motion, self.speed)

    @property
    def visible_motion(self) -> Motion:
        """The motion that can be seen: `stopped` unless the wheels turn."""
        return self.motion if self.moving else Motion.STOPPED


VARIABLES = tuple(State.__dataclass_fields__)


class Moment(StrEnum):
    """The kinds of frames by what they do to the motion; a setting leaves it as it is."""

    FAULT = "fault"
    STOP = "stop"
    DRIVE = "drive"
    ROTATION = "rotation"
    SETTING = "setting"


MOTIONS = (Moment.DRIVE, Moment.ROTATION)


@dataclass(frozen=True, slots=True)
class Effect:
    """Assignments to state variables: (variable, value) or (variable, (field, factor))."""

    assignments: tuple[tuple[str, int | Motion | tuple[str, int]], ...] = ()

    def apply(self, state: State, fields: Mapping[str, int] | None = None) -> State:
        """Return the state after this effect; `fields` are the instruction's values by name."""
        if not self.assignments:
            return state
        values: dict[str, Any] = {
            variable: (fields or {})[value[0]] * value[1] if isinstance(value, tuple) else value
            for variable, value in self.assignments
        }
        given = values.get
        return State(
            given("motion", state.motion),
            given("speed", state.speed),
            given("steering", state.steering),
            given("led", state.led),
        )

    def sets(self, variable: str) -> bool:
        """Return whether this effect assigns to the variable."""
        return any(name == variable for name, _ in self.assignments)

    @property
    def motion(self) -> Motion | None:
        """The kind of motion that this effect sets, None if it leaves it."""
        return next(
            (v for n, v in self.assignments if n == "motion" and isinstance(v, Motion)), None
        )


def rotates(motion: Motion) -> bool:
    """Return whether a kind of motion turns the wheels against each other."""
    left, right = WHEELS[motion]
    return left != right


def moment_of(effect: Effect | None) -> Moment:
    """Return the kind of a frame from its instruction's effect, None for a faulty frame."""
    if effect is None:
        return Moment.FAULT
    if effect.motion is None:
        return Moment.SETTING
    if effect.motion is Motion.STOPPED:
        return Moment.STOP
    return Moment.ROTATION if rotates(effect.motion) else Moment.DRIVE


def wheels(state: State, full_steering: int) -> tuple[int, int]:
    """Return the wheel speeds (left, right) of the reference robot, forward positive.

    The document gives no mixing law: the reference slows the inner wheel in proportion to the
    steering (at `full_steering` it stands still), and does not steer while it rotates. A test may
    therefore judge only the signs and which wheel is faster.
    """
    left, right = WHEELS[state.visible_motion]
    inner = state.speed
    if state.motion in (Motion.FORWARD, Motion.BACKWARD) and full_steering:
        inner = state.speed * (full_steering - abs(state.steering)) // full_steering
    return (
        left * (inner if state.steering < 0 else state.speed),
        right * (inner if state.steering > 0 else state.speed),
    )
