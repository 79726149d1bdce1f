"""The robot car's own states and the model of one, for tests that give them by value."""

from __future__ import annotations

from collections.abc import Mapping

from bilprov.captures.topics import CAR_STATE
from bilprov.conformance.oracle.profile import Choices
from bilprov.conformance.oracle.state_model import FAULT, FrameEffect, Model
from bilprov.spec import grammar
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol
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


def frame_effect(protocol: Protocol, name: str, *values: int) -> FrameEffect:
    """What an instruction does with these values; a fault where there is none of that name."""
    if name not in protocol.by_name:
        return FAULT
    spec = protocol.by_name[name]
    fields = {part.name: value for part, value in zip(spec.fields, values, strict=True)}
    return FrameEffect(spec.effect, fields)


def model_of(protocol: Protocol, shown: Mapping[str, str] | None = None) -> Model:
    """The model of a device that has shown these words, by point."""
    choices = Choices()
    for point, word in (shown or {}).items():
        assert choices.record(point, word, "before") == ""
    return Model(protocol, choices)
