"""Judges frames one by one, and remembers what it can: as `codec.judge` and `Effect.apply` say."""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

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

    A frame whose data decide nothing is judged once for all data; of the others at most 65,536
    are remembered. Raises ValueError, as `codec.judge` does, for bytes that are not one frame.
    """

    def __init__(self, protocol: Protocol) -> None:
        super().__init__()
        self._protocol = protocol
        self._faulty: dict[tuple[int, int], Step] = {}

    def __missing__(self, frame: bytes) -> Step:
        protocol = self._protocol
        if frame and not data_decide(protocol, frame):
            return self._independent(frame)
        judgement = judge(protocol, frame)
        step = self._step(judgement)
        if len(self) < _REMEMBERED:
            self[frame] = step
        return step

    def _independent(self, frame: bytes) -> Step:
        """The step of a frame that is faulty whatever its data are."""
        key = frame[0], len(frame)
        known = self._faulty.get(key)
        if known is None:
            known = self._faulty[key] = self._step(judge(self._protocol, frame))
        return replace(known, judgement=replace(known.judgement, frame=frame))

    def _step(self, judgement: Judgement) -> Step:
        effect = self._protocol.on_fault
        if judgement.valid and judgement.instruction:
            effect = judgement.instruction.effect
        return Step(judgement, assigned(effect, dict(judgement.fields)))


def data_decide(protocol: Protocol, frame: bytes) -> bool:
    """Whether a frame's data decide its outcome: it has an instruction's header and length."""
    if not protocol.plain:
        return True
    identity, length = protocol.headers[frame[0]]
    known = protocol.by_id.get(identity)
    return known is not None and known.length == length == len(frame) - 1
