"""The states in which cases begin, the steps that lead there, and where each step leads."""

from __future__ import annotations

from bilprov.conformance.cases.steps import Step, step_of
from bilprov.spec.by_effect import frames_to, reached
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.state import State


def full_state(protocol: Protocol, mover: InstructionSpec) -> State:
    """A state in a motion, with every variable far from its value at rest."""
    ends = {
        # To the right where it steers both ways, and no speed backward.
        name: high if name == "speed" else max(high, low, key=abs)
        for name, (low, high) in protocol.limits.items()
    }
    return reached(protocol, protocol.state(motion=mover.effect.motion or Motion.STOPPED, **ends))


def steps_to(protocol: Protocol, state: State, known: State | None = None) -> tuple[Step, ...]:
    """The fewest instructions that bring a robot to a state, see `frames_to`."""
    return tuple(step_of(protocol, frame) for frame in frames_to(protocol, state, known))


def state_after(protocol: Protocol, state: State, step: Step) -> State:
    """The reference's state after a step."""
    return (step.frame_effect.effect or protocol.on_fault).apply(state, step.frame_effect.values)
