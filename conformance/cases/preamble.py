"""The states in which cases begin, and what the frames of the preamble do."""

from __future__ import annotations

from functools import lru_cache

from bilprov.conformance.oracle.state_model import FrameEffect
from bilprov.spec.by_effect import reached
from bilprov.spec.codec import judge
from bilprov.spec.motion import Motion, State
from bilprov.spec.protocol import InstructionSpec, Protocol


def full_state(protocol: Protocol, mover: InstructionSpec) -> State:
    """A state in a motion, with every variable far from its value at rest."""
    ends = {
        # To the right where it steers both ways, and no speed backward.
        name: high if name == "speed" else max(high, low, key=abs)
        for name, (low, high) in protocol.limits.items()
    }
    return reached(protocol, State(mover.effect.motion or Motion.STOPPED, **ends))


@lru_cache(maxsize=1 << 12)
def frame_effect_of(protocol: Protocol, frame: bytes) -> FrameEffect:
    """The effect of a valid frame."""
    judged = judge(protocol, frame)
    assert judged.valid
    assert judged.instruction is not None
    return FrameEffect(judged.instruction.effect, dict(judged.fields))
