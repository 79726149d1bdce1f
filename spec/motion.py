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


# Which way (left, right) the wheels turn in each kind of motion.
WHEELS = {
    Motion.STOPPED: (0, 0),
    Motion.FORWARD: (1, 1),
    Motion.BACKWARD: (-1, -1),
    Motion.ROTATE_RIGHT: (1, -1),
    Motion.ROTATE_LEFT: (-1, 1),
}


@dataclass(frozen=True, slots=True)
class State:
    """What the robot is set to: kind of motion, speed, steering (right positive) and LED."""

    motion: Motion = Motion.STOPPED
    speed: int = 0
    steering: int = 0
    led: int = 0

    @property
    def moving(self) -> bool:
        """Whether the wheels turn: a direction with speed 0 does not move (R-speed-zero)."""
        return self.motion is not Motion.STOPPED and self.speed > 0

    @property
    def visible_motion(self) -> Motion:
        """What the wheels do now: `stopped` unless they turn."""
        return self.motion if self.moving else Motion.STOPPED


VARIABLES = tuple(State.__dataclass_fields__)


@dataclass(frozen=True, slots=True)
class Effect:
    """Assignments to state variables: (variable, value) or (variable, (field, factor))."""

    assignments: tuple[tuple[str, int | Motion | tuple[str, int]], ...] = ()

    def apply(self, state: State, fields: Mapping[str, int] | None = None) -> State:
        """The state after this effect, with the instruction's field values at hand."""
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
        """Whether this effect assigns to the variable."""
        return any(name == variable for name, _ in self.assignments)

    @property
    def motion(self) -> Motion | None:
        """The kind of motion that this effect sets, None if it leaves it."""
        return next(
            (v for n, v in self.assignments if n == "motion" and isinstance(v, Motion)), None
        )


def wheels(state: State, full_steering: int) -> tuple[int, int]:
    """The wheels' speeds (left, right) of the reference robot, forward positive.

    The document gives no mixing law: the reference slows the inner wheel in proportion to the
    steering (`full_steering` stands it still), and does not steer while it rotates. Judge only the
    signs and which wheel is faster.
    """
    left, right = WHEELS[state.visible_motion]
    inner = state.speed
    if state.motion in (Motion.FORWARD, Motion.BACKWARD) and full_steering:
        inner = state.speed * (full_steering - abs(state.steering)) // full_steering
    return (
        left * (inner if state.steering < 0 else state.speed),
        right * (inner if state.steering > 0 else state.speed),
    )
