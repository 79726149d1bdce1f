"""Supplies frames to send, by kind; the data of each kind rotate through all their values.

A kind is an instruction's name, or a class of faulty frame. The next frame of a kind takes the next
of its values, so that each value is sent between ever other neighbours.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from itertools import cycle

from bilprov.conformance.cases.steps import (
    TOO_FEW,
    TOO_MANY,
    FrameClass,
    Step,
    framed,
    frames_of,
    headers_of,
)
from bilprov.spec.by_effect import movers
from bilprov.spec.protocol import InstructionSpec, Protocol

FILLS = 3
"""Number of ways to fill faulty frames: Stop bytes, a motion (seen if it is run), all bits set."""

_STEP = 83  # from one byte of a fill to the next: odd, and far from the values at its neighbours


class Inputs:
    """A seeded supply of frames.

    `kinds` are the kinds that this protocol has, without truncated frames; `next` supplies those
    too.
    """

    def __init__(self, protocol: Protocol, seed: int) -> None:
        self._draw = random.Random(f"inputs {seed}")
        self._protocol = protocol
        self._turn = 0
        self._supplies: dict[str, Iterator[Step]] = {}
        for spec in protocol.instructions:
            self._supplies[spec.name] = self._valid(spec)
        for kind in (FrameClass.UNUSED_ID, TOO_MANY, TOO_FEW):
            if headers_of(protocol, kind):
                self._supplies[kind] = self._whole(headers_of(protocol, kind))
        bad = list(frames_of(protocol, FrameClass.BAD_DATA))
        if bad:
            self._supplies[FrameClass.BAD_DATA] = cycle(self._draw.sample(bad, len(bad)))
        self.kinds = tuple(self._supplies)
        cuts = list(frames_of(protocol, FrameClass.TRUNCATED, self.fill))
        self._supplies[FrameClass.TRUNCATED] = cycle(self._draw.sample(cuts, len(cuts)))
        self.valid_kinds = tuple(spec.name for spec in protocol.instructions)
        self.faulty_kinds = tuple(k for k in self.kinds if k not in self.valid_kinds)
        self.movers = tuple(s.name for s in movers(protocol))
        self.settings = tuple(
            s.name for s in protocol.instructions if not s.effect.sets(protocol.car.by)
        )

    def next(self, kind: str) -> Step:
        """The next frame of a kind."""
        return next(self._supplies[kind])

    def fill(self, length: int) -> bytes:
        """`length` data bytes for a faulty frame; each call takes the next way to fill them.

        One way takes the next values, so that every value comes to stand at every place.
        """
        self._turn += 1
        way, turn = self._turn % (FILLS + 1), self._turn // (FILLS + 1)
        if way < FILLS:
            return fill(self._protocol, length, way)
        return bytes((turn + _STEP * place) % 256 for place in range(length))

    def _valid(self, spec: InstructionSpec) -> Iterator[Step]:
        steps = list(frames_of(self._protocol, spec.name))
        limits = {f.name: (f.low, f.high) for f in spec.fields}
        ends = [
            step
            for step in steps
            if all(value in limits[name] for name, value in step.frame_effect.values.items())
        ]
        # The ends of a range come more often than the rest: counters and signs turn over there.
        while True:
            for index, step in enumerate(self._draw.sample(steps, len(steps))):
                yield step
                if index % 6 == 5 and len(steps) > 2 * len(ends):
                    yield self._draw.choice(ends)

    def _whole(self, headers: Sequence[tuple[int, int, int]]) -> Iterator[Step]:
        while True:
            for identity, length, _ in self._draw.sample(headers, len(headers)):
                yield framed(self._protocol, identity, length, self.fill(length))


def fill(protocol: Protocol, length: int, turn: int) -> bytes:
    """Data of a faulty frame: Stop bytes, a motion that is seen if it is run, or all bits set."""
    mover = next(iter(movers(protocol)), protocol.stop)
    fills = (protocol.pad_byte, protocol.header_bytes[mover.id, mover.length], 0xFF)
    return bytes([fills[turn % FILLS]]) * length
