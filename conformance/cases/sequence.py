"""Test sequences: frames from the motion model, sent in bursts, with a look after each burst.

A sequence is a value, like every case: what is sent, in which bursts and with which pauses. The
expected states are the model's (`conformance.oracle.state_model`), with the choices that the device
has shown.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar

from bilprov.conformance.cases.steps import Step
from bilprov.spec.protocol import Protocol

T = TypeVar("T")

DELIVERIES = ("waited", "pipelined", "split", "left alone")
"""The ways in which a burst that ends with a complete frame is delivered."""


@dataclass(frozen=True, slots=True)
class Burst:
    """Frames that are sent in one go; their answers and then the robot's state are judged.

    `pauses` are the places (bytes from the burst's beginning) where the line pauses, well below the
    time-out; a truncated frame stands last and is followed by nothing until its time-out. `looks`
    is false where the state after the burst is not observed. `idle_ms` (ms) is how long the robot
    is then sent nothing and observed.
    """

    steps: tuple[Step, ...]
    pauses: tuple[int, ...] = ()
    looks: bool = True
    idle_ms: int = 0

    @property
    def data(self) -> bytes:
        """The bytes as they are sent."""
        return b"".join(step.frame for step in self.steps)

    @property
    def delivery(self) -> str:
        """How the burst is delivered: waited, pipelined, split, left alone or cut (truncated)."""
        if self.steps[-1].truncated:
            return "cut"
        if self.pauses:
            return "split"
        if self.idle_ms:
            return "left alone"
        return "pipelined" if len(self.steps) > 1 else "waited"


@dataclass(frozen=True, slots=True)
class SequenceCase:
    """A test case of many frames.

    `setup`, the preamble, brings the robot to a known state, one instruction at a time, before the
    first burst. A `seeded` sequence can be made again from its id and the run's seed: where it
    passes, a report keeps only how many frames it had. `facets` are what a probe must tell of the
    robot for the sequence to be of use. One that is `proving` is part of a proof: an answer must
    not come as late as a time-out.
    """

    id: str
    clause: str
    requirement: str
    setup: tuple[Step, ...]
    bursts: tuple[Burst, ...]
    reading: str = ""
    seeded: bool = False
    facets: tuple[str, ...] = ()
    proving: bool = False

    @classmethod
    def of(
        cls, protocol: Protocol, ident: str, requirement: str, bursts: Iterable[Burst], **more: Any
    ) -> SequenceCase:
        """The sequence of these bursts, about what instructions do; `more` are further fields."""
        fields = {"setup": (), "clause": protocol.clauses.instructions} | more
        return cls(id=ident, requirement=requirement, bursts=tuple(bursts), **fields)

    @property
    def sent(self) -> tuple[bytes, ...]:
        """The bytes of each burst."""
        return tuple(burst.data for burst in self.bursts)

    @property
    def frames(self) -> int:
        """How many frames are under test."""
        return sum(len(burst.steps) for burst in self.bursts)

    @property
    def pipelined(self) -> bool:
        """Whether it observes what instructions do that are sent ahead of an answer."""
        return any(burst.looks and len(burst.steps) > 1 for burst in self.bursts)

    @property
    def steps(self) -> Iterator[Step]:
        """Every step in order."""
        for burst in self.bursts:
            yield from burst.steps


def leading(steps: Sequence[Step]) -> Iterator[Burst]:
    """Yield the burst of the frames that lead to a state, sent ahead and not observed, if any."""
    if steps:
        yield Burst(tuple(steps), looks=False)


def chunks(values: Iterable[T], size: int) -> Iterator[tuple[T, ...]]:
    """Yield the values in groups of so many; the last may be smaller."""
    left = iter(values)
    while chunk := tuple(islice(left, size)):
        yield chunk
