"""The states in which cases begin, the steps that lead there, and where each step leads."""

from __future__ import annotations

from collections.abc import Mapping

from bilprov.conformance.cases.steps import Step, step_of
from bilprov.spec.by_effect import frames_to, reached
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.state import State


def full_state(protocol: Protocol, mover: InstructionSpec) -> State:
    """A state in a motion, with every variable far from its value at rest."""
    car = protocol.car
    ends = {
        # To the right where it steers both ways, and no speed backward.
        name: high if name == car.speed else max(high, low, key=abs)
        for name, (low, high) in protocol.limits.items()
    }
    motion = car.motion(mover.effect) or car.still
    return reached(protocol, protocol.state(**ends, **{car.by: motion}))


def in_motion(
    protocol: Protocol,
    motion: str | None,
    speed: int | None = None,
    lights: Mapping[str, int] | None = None,
) -> State:
    """A robot's state straight on in a motion (None: it stands), at the greatest speed or this."""
    car, fast = protocol.car, protocol.speeds[1]
    driving = {car.by: motion or car.still, car.speed: fast if speed is None else speed}
    return protocol.state(**driving, **(lights or {}))


def steps_to(protocol: Protocol, state: State, known: State | None = None) -> tuple[Step, ...]:
    """The fewest instructions that bring a robot to a state, see `frames_to`."""
    return tuple(step_of(protocol, frame) for frame in frames_to(protocol, state, known))


def state_after(protocol: Protocol, state: State, step: Step) -> State:
    """The reference's state after a step."""
    return (step.frame_effect.effect or protocol.on_fault).apply(state, step.frame_effect.values)
