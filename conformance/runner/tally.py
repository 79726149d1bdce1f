"""The tally of a run: every frame that went to the device since power-on, in order, by kind.

It frames the bytes as the device must, by header and truncation time-out, whichever part of the
runner sent them. A mismatch has its place in it, from which a rhythm is fitted (`runner.rhythm`).
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

from bilprov.conformance.cases.coverage import kind_of
from bilprov.conformance.cases.steps import FrameClass, complete_frame
from bilprov.conformance.dut.operations import (
    Ended,
    Observation,
    Operation,
    PowerCycle,
    Procedure,
    Received,
    Reply,
    Send,
)
from bilprov.conformance.runner.waiting import Waiting
from bilprov.spec.protocol import Protocol

T = TypeVar("T")


class Place(NamedTuple):
    """Where a mismatch was met: the numbers (from 1) of the first and last frame it may be of."""

    first: int
    last: int


class Tally:
    """The frames since power-on; a power cycle begins it anew.

    `kinds` has the kind of each (`cases.coverage.kind_of`), `examples` one complete frame of each
    kind, `places` those of the mismatches in cases, `cycles` how often the power was switched.
    """

    def __init__(self, protocol: Protocol, waiting: Waiting) -> None:
        self.kinds: list[str] = []
        self.examples: dict[str, bytes] = {}
        self.places: list[Place] = []
        self.cycles = 0
        self._protocol = protocol
        self._waiting = waiting
        self._known: dict[bytes, str] = {}
        self._held = b""
        self._last = 0

    @property
    def frames(self) -> int:
        """How many frames there were."""
        return len(self.kinds)

    def count(self, counter: str, frames: int | None = None) -> int:
        """How many of the first `frames` frames (all if None) this counter counts."""
        return sum(counts(self._protocol, counter, kind) for kind in self.kinds[:frames])

    def did(self, operation: Operation, reply: Reply) -> None:
        """Take note of an operation that was done."""
        if isinstance(operation, Send) and isinstance(reply, int):
            self._last = reply
            self._held += operation.data
            self._split()
        elif isinstance(operation, PowerCycle):
            self.kinds, self.places, self._held = [], [], b""
            self.cycles += 1
        elif isinstance(reply, Received | Observation):
            self._silent_until(reply.now)

    def _silent_until(self, now: int) -> None:
        """End a truncated frame where nothing was sent for the time-out until `now` (ns)."""
        if self._held and now - self._last >= self._waiting.timeout:
            self._held = b""
            self.kinds.append(FrameClass.TRUNCATED)

    def _split(self) -> None:
        lengths = self._protocol.lengths
        while self._held and len(self._held) > lengths[self._held[0]]:
            end = 1 + lengths[self._held[0]]
            frame, self._held = self._held[:end], self._held[end:]
            kind = self._known.get(frame)
            if kind is None:
                step = complete_frame(self._protocol, frame[0], frame[1:])
                kind = self._known[frame] = kind_of(self._protocol, step)
                self.examples.setdefault(kind, frame)
            self.kinds.append(kind)


FRAME, FAULT = "frame", "faulty frame"
"""The counters of every frame and of every faulty one; any other is the kind that it counts."""


def counts(protocol: Protocol, counter: str, kind: str) -> bool:
    """Whether the counter counts frames of this kind."""
    if counter == FAULT:
        return kind not in protocol.by_name
    return counter in (FRAME, kind)


def tallied(procedure: Procedure[T], tally: Tally) -> Procedure[T]:
    """The procedure, every operation of which the tally takes note of."""
    reply: Reply | None = None
    error: Ended | None = None
    while True:
        try:
            operation = procedure.throw(error) if error else procedure.send(reply)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]  # what the generator's type says
        error = None
        try:
            reply = yield operation
        except Ended as ended:
            error = ended
        else:
            assert reply is not None
            tally.did(operation, reply)
