"""Walks: sequences of frames from the motion model, delivered in every way, looked at as they go.

A walk is a value, like every case: what is sent, in which bursts and with which pauses. What must
come of it is the model's (`conformance.model`), with the choices that the device has shown.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from conformance.cases.steps import Step
from conformance.oracle.verdicts import Axis


@dataclass(frozen=True, slots=True)
class Burst:
    """Frames that are sent in one go, then answered, then looked at.

    `pauses` are the places (bytes from the burst's beginning) where the line pauses, well below the
    time-out; a cut frame stands last and is left alone until its time-out. `looks` is false where
    the state between two bursts is not asked for. `dwell` (ms) is how long the robot is then left
    alone and looked at.
    """

    steps: tuple[Step, ...]
    pauses: tuple[int, ...] = ()
    looks: bool = True
    dwell: int = 0

    @property
    def data(self) -> bytes:
        """The bytes as they are sent."""
        return b"".join(step.frame for step in self.steps)

    @property
    def delivery(self) -> str:
        """How it is delivered: waited, pipelined, split or cut."""
        if self.steps[-1].cut:
            return "cut"
        if self.pauses:
            return "split"
        if self.dwell:
            return "left alone"
        return "pipelined" if len(self.steps) > 1 else "waited"


@dataclass(frozen=True, slots=True)
class Walk:
    """A case of many frames.

    `setup` brings the robot to a known state, one instruction at a time, before the first burst.
    """

    id: str
    clause: str
    requirement: str
    setup: tuple[Step, ...]
    bursts: tuple[Burst, ...]
    reading: str = ""

    @property
    def sent(self) -> tuple[bytes, ...]:
        """The bytes of each burst."""
        return tuple(burst.data for burst in self.bursts)

    @property
    def pipelined(self) -> bool:
        """Whether it sends instructions before the last one was answered."""
        return any(len(burst.steps) > 1 for burst in self.bursts)

    @property
    def steps(self) -> Iterator[Step]:
        """Every step in order."""
        for burst in self.bursts:
            yield from burst.steps


@dataclass(frozen=True, slots=True)
class Mismatch:
    """Where a walk went wrong: the step, the axis that says how, and the clause that it breaks.

    `burst` is the burst's index, below 0 in the set-up.
    """

    step: Step
    name: str
    axis: Axis
    clause: str
    burst: int = 0
