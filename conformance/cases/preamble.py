"""The preamble: the instructions that bring a robot into a state, found by their effects."""

from __future__ import annotations

from functools import lru_cache

from bilprov.conformance.oracle.state_model import FrameEffect
from bilprov.spec.by_effect import moving_to, setting
from bilprov.spec.codec import build, judge
from bilprov.spec.motion import Motion, State, rotates
from bilprov.spec.protocol import InstructionSpec, Protocol


def frames_to(protocol: Protocol, state: State) -> tuple[bytes, ...]:
    """The frames that bring a stopped robot to `state`: speed and LED, the motion, the steering.

    A speed comes first, because a device may take it up only at the next motion (R-speed-moving),
    steering last, because a motion may reset it (R-drive-steering, R-rotate-steering). A variable
    that no instruction of the protocol sets is left as it is.
    """
    mover = moving_to(protocol, state.motion)
    motion = build(protocol, mover.name) if mover and state.motion is not Motion.STOPPED else b""
    speed, led, steering = (
        setting(protocol, variable, getattr(state, variable))
        for variable in ("speed", "led", "steering")
    )
    # Steering during a rotation may become a curve (R-steer-rotating).
    late = (steering, motion) if rotates(state.motion) else (motion, steering)
    return tuple(frame for frame in (speed, led, *late) if frame)


def full_state(protocol: Protocol, mover: InstructionSpec) -> State:
    """A state in a motion, with every variable far from its value at rest."""
    ends = {name: high for name, (_, high) in protocol.limits.items()}
    return State(mover.effect.motion or Motion.STOPPED, **ends)


@lru_cache(maxsize=1 << 12)
def frame_effect_of(protocol: Protocol, frame: bytes) -> FrameEffect:
    """The effect of a valid frame."""
    judged = judge(protocol, frame)
    assert judged.valid
    assert judged.instruction is not None
    return FrameEffect(judged.instruction.effect, dict(judged.fields))
