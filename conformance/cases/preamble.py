"""The instructions that bring a robot into a state, found by their effects."""

from __future__ import annotations

from functools import lru_cache

from conformance.oracle.state_model import Deed
from spec.codec import build, judge
from spec.motion import WHEELS, Motion, State
from spec.protocol import InstructionSpec, Protocol


def frames_to(protocol: Protocol, state: State) -> tuple[bytes, ...]:
    """The frames that bring a stopped robot to `state`: speed and LED, the motion, the steering.

    A speed comes first, because a device may take it up only at the next motion (R-speed-moving),
    steering last, because a motion may reset it (R-drive-steering). A variable that no instruction
    of the protocol sets is left as it is.
    """
    mover = moving_to(protocol, state.motion)
    motion = build(protocol, mover.name) if mover and state.motion is not Motion.STOPPED else b""
    speed, led, steering = (
        setting(protocol, variable, getattr(state, variable))
        for variable in ("speed", "led", "steering")
    )
    # Steering during a rotation may become a curve (R-steer-rotating).
    left, right = WHEELS[state.motion]
    late = (motion, steering) if left == right else (steering, motion)
    return tuple(frame for frame in (speed, led, *late) if frame)


def deed_of(protocol: Protocol, frame: bytes) -> Deed:
    """What a valid frame does."""
    judged = judge(protocol, frame)
    assert judged.valid
    assert judged.instruction is not None
    return Deed(judged.instruction.effect, dict(judged.fields))


def moves(spec: InstructionSpec) -> bool:
    """Whether the instruction sets a motion."""
    return spec.effect.motion not in (None, Motion.STOPPED)


def moving_to(protocol: Protocol, motion: Motion) -> InstructionSpec | None:
    """The instruction without data that sets this kind of motion."""
    return next(
        (s for s in protocol.instructions if s.effect.motion is motion and not s.fields), None
    )


@lru_cache(maxsize=1 << 12)
def setting(protocol: Protocol, variable: str, value: int) -> bytes:
    """The frame that sets a variable and leaves the motion alone, b"" if there is none."""
    for spec in protocol.instructions:
        if spec.effect.sets("motion"):
            continue
        for name, source in spec.effect.assignments:
            if name != variable or not isinstance(source, tuple):
                continue
            field, factor = source
            part = next(f for f in spec.fields if f.name == field)
            wanted = value // factor
            if wanted * factor == value and part.low <= wanted <= part.high:
                values = {f.name: f.low for f in spec.fields} | {field: wanted}
                return build(protocol, spec.name, values)
    return b""
