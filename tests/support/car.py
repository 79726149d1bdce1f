"""The robot car's own states, for tests that give them by value."""

from __future__ import annotations

from bilprov.captures.topics import CAR_STATE
from bilprov.spec import grammar
from bilprov.spec.motion import Motion
from bilprov.spec.state import State

VARIABLES = tuple(grammar.STATE.specs)


def car_state(
    motion: str = Motion.STOPPED, speed: int = 0, steering: int = 0, led: int = 0
) -> State:
    """The state of a car with these values."""
    values = {"motion": str(motion), "speed": speed, "steering": steering, "led": led}
    return CAR_STATE.of(values)


def wheels(state: State, full_steering: int) -> tuple[int, int]:
    """The wheel speeds (left, right) of the reference robot in a state."""
    return grammar.WHEELS.wheels(state, full_steering)
