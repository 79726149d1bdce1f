"""What can be sent at a robot: kinds of frames, each with its data rotated through all values.

A kind is an instruction's name, or a class of faulty frame. The next frame of a kind takes the next
of its values, so that every byte is met in ever other company.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from itertools import cycle

from conformance.cases.steps import Class, Step, bad, cut, unused, valid, wrong_length
from spec.codec import all_data, bad_data
from spec.motion import Motion
from spec.protocol import InstructionSpec, Protocol

TOO_MANY, TOO_FEW = "too-many", "too-few"
FILLS = 3
"""Ways to fill the data of a faulty frame: stops, a motion (seen if it is run), all bits set."""


class Inputs:
    """A seeded supply of frames. `kinds` are the kinds that this protocol has."""

    def __init__(self, protocol: Protocol, seed: int) -> None:
        self._draw = random.Random(f"inputs {seed}")
        self._protocol = protocol
        self._turn = 0
        self._supplies: dict[str, Iterator[Step]] = {}
        for spec in protocol.instructions:
            self._supplies[spec.name] = self._valid(spec)
        lengths = protocol.data_lengths
        self._add(Class.UNUSED_ID, [(i, n) for i in protocol.unused_ids for n in lengths])
        many = [(s.id, n) for s in protocol.instructions for n in lengths if n > s.length]
        few = [(s.id, n) for s in protocol.instructions for n in lengths if n < s.length]
        self._add(TOO_MANY, many)
        self._add(TOO_FEW, few)
        bads = [(s, data) for s in protocol.instructions for data in bad_data(s)]
        if bads:
            steps = [bad(protocol, spec, data) for spec, data in bads]
            self._supplies[Class.BAD_DATA] = cycle(self._shuffled(steps))
        self.kinds = tuple(self._supplies)
        self._supplies[Class.TRUNCATED] = cycle(self._shuffled(list(self._cuts())))
        self.valid_kinds = tuple(spec.name for spec in protocol.instructions)
        self.faulty_kinds = tuple(k for k in self.kinds if k not in self.valid_kinds)
        self.movers = tuple(s.name for s in protocol.instructions if _moves(s))
        self.settings = tuple(s.name for s in protocol.instructions if not s.effect.sets("motion"))

    def next(self, kind: str) -> Step:
        """The next frame of a kind."""
        return next(self._supplies[kind])

    def fill(self, length: int) -> bytes:
        """Data for a faulty frame, in one of the ways to fill them, in turn."""
        self._turn += 1
        return fill(self._protocol, length, self._turn)

    def _shuffled(self, values: list[Step]) -> list[Step]:
        return self._draw.sample(values, len(values))

    def _valid(self, spec: InstructionSpec) -> Iterator[Step]:
        values = [
            {f.name: f.parse(data[f.offset : f.offset + f.size]) for f in spec.fields}
            for data in all_data(spec)
        ]
        ends = [v for v in values if all(v[f.name] in (f.low, f.high) for f in spec.fields)]
        # The ends come more often than the rest: that is where counters and signs turn over.
        while True:
            for index, value in enumerate(self._draw.sample(values, len(values))):
                yield valid(self._protocol, spec, value)
                if index % 6 == 5 and len(values) > 2 * len(ends):
                    yield valid(self._protocol, spec, self._draw.choice(ends))

    def _add(self, kind: str, headers: list[tuple[int, int]]) -> None:
        if headers:
            self._supplies[kind] = self._whole(headers)

    def _whole(self, headers: list[tuple[int, int]]) -> Iterator[Step]:
        protocol = self._protocol
        while True:
            for identity, length in self._draw.sample(headers, len(headers)):
                spec, data = protocol.by_id.get(identity), self.fill(length)
                if spec is None:
                    yield unused(protocol, identity, length, data)
                else:
                    yield wrong_length(protocol, spec, length, data)

    def _cuts(self) -> Iterator[Step]:
        for identity, length in self._protocol.headers:
            for arrived in range(length):
                yield cut(self._protocol, identity, length, self.fill(arrived))


def fill(protocol: Protocol, length: int, turn: int) -> bytes:
    """Data of a faulty frame: stops, a motion that is seen if it is run, or all bits set."""
    mover = next((s for s in protocol.instructions if _moves(s)), protocol.stop)
    fills = (protocol.filler, protocol.header_bytes[mover.id, 0], 0xFF)
    return bytes([fills[turn % FILLS]]) * length


def _moves(spec: InstructionSpec) -> bool:
    return spec.effect.motion not in (None, Motion.STOPPED) and not spec.length
