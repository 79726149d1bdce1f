"""What only a car has: kinds of motion, and how its wheels turn in them."""

from __future__ import annotations

from enum import StrEnum

from bilprov.spec import grammar
from bilprov.spec.state import Effect, State, Wheels, state_class

# What the built-in grammar declares stands for the car's in texts that do not declare it.
CAR, CAR_AT_REST, CAR_WHEELS = grammar.STATE, grammar.AT_REST, grammar.WHEELS
CAR_NOUN = grammar.DEVICE


class Motion(StrEnum):
    """The kinds of motion of a two-wheeled car."""

    STOPPED = "stopped"
    FORWARD = "forward"
    BACKWARD = "backward"
    ROTATE_RIGHT = "rotate_right"
    ROTATE_LEFT = "rotate_left"


# The direction in which the wheels (left, right) turn in each kind of motion.
WHEELS = {motion: CAR_WHEELS.turns.get(motion, (0, 0)) for motion in Motion}


def visible_motion(state: State) -> Motion:
    """The motion that can be seen: `stopped` unless the wheels turn."""
    return Motion(state.motion) if state.moving else Motion.STOPPED


VARIABLES = tuple(CAR.kinds)


class Moment(StrEnum):
    """The kinds of frames by what they do to the motion; a setting leaves it as it is."""

    FAULT = "fault"
    STOP = "stop"
    DRIVE = "drive"
    ROTATION = "rotation"
    SETTING = "setting"


MOTIONS = (Moment.DRIVE, Moment.ROTATION)


def rotates(motion: str) -> bool:
    """Return whether a kind of motion turns the wheels against each other."""
    left, right = CAR_WHEELS.turns.get(motion, (0, 0))
    return left != right


def moment_of(effect: Effect | None) -> Moment:
    """Return the kind of a frame from its instruction's effect, None for a faulty frame."""
    if effect is None:
        return Moment.FAULT
    if effect.motion is None:
        return Moment.SETTING
    if effect.motion == Motion.STOPPED:
        return Moment.STOP
    return Moment.ROTATION if rotates(effect.motion) else Moment.DRIVE


def wheels(state: State, full_steering: int, car: Wheels = CAR_WHEELS) -> tuple[int, int]:
    """Return the wheel speeds (left, right) of the reference robot, forward positive.

    The document gives no mixing law: the reference slows the inner wheel in proportion to the
    steering (at `full_steering` it stands still), and does not steer while it rotates. A test may
    therefore judge only the signs and which wheel is faster.
    """
    motion, speed, steering = (getattr(state, name) for name in (car.by, car.speed, car.steering))
    left, right = car.turns.get(motion, (0, 0)) if state.moving else (0, 0)
    inner = speed
    if left == right and full_steering:
        inner = speed * (full_steering - abs(steering)) // full_steering
    return left * (inner if steering < 0 else speed), right * (inner if steering > 0 else speed)


def car_state(
    motion: str = Motion.STOPPED, speed: int = 0, steering: int = 0, led: int = 0
) -> State:
    """The state of a car with these values."""
    values = {"motion": str(motion), "speed": speed, "steering": steering, "led": led}
    return CAR_STATE.of(values)


CAR_STATE = state_class(tuple(kind.spec(name) for name, kind in CAR.kinds.items()), CAR_AT_REST)
