"""Judges frames one by one, and remembers what it can: as `codec.judge` and `Effect.apply` say."""

from __future__ import annotations

import msgspec

from bilprov.spec.codec import Judgement, judge
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import Assigned, assigned

_REMEMBERED = 1 << 16  # frames


class Step(msgspec.Struct, frozen=True, gc=False):
    """One frame's judgement, and the state variables that it sets with their new values."""

    judgement: Judgement
    sets: Assigned


class Steps(dict[bytes, Step]):
    """The Step of each frame by its bytes (whole, or cut short): `steps[frame]`.

    At most 65,536 are remembered; then all are forgotten. Raises ValueError, as `codec.judge` does,
    for bytes that are not one frame.
    """

    def __init__(self, protocol: Protocol) -> None:
        super().__init__()
        self._protocol = protocol

    def __missing__(self, frame: bytes) -> Step:
        step = self._step(judge(self._protocol, frame))
        if len(self) >= _REMEMBERED:
            self.clear()
        self[frame] = step
        return step

    def _step(self, judgement: Judgement) -> Step:
        effect = self._protocol.on_fault
        if judgement.valid and judgement.instruction:
            effect = judgement.instruction.effect
        return Step(judgement, assigned(effect, dict(judgement.fields)))
