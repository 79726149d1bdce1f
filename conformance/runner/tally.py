"""The tally of a run: every frame that went to the device since power-on, in order, by kind.

It frames the bytes as the device must, by header and truncation time-out, whichever part of the
runner sent them. A mismatch has its place in it, from which a rhythm is fitted (`runner.rhythm`).
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from bilprov.analyzer.client.operations import (
    Observation,
    Operation,
    PowerCycle,
    Received,
    Reply,
    Send,
)
from bilprov.conformance.cases.coverage import kind_of
from bilprov.conformance.cases.steps import FrameClass, complete_frame
from bilprov.conformance.runner.waiting import Waiting
from bilprov.spec.protocol import Protocol


class Place(NamedTuple):
    """Where a mismatch was met: the numbers (from 1) of the first and last frame it may be of."""

    first: int
    last: int


class Sent(NamedTuple):
    """What is counted of a frame: its kind (`cases.coverage.kind_of`) and its instruction ID."""

    kind: str
    identity: int


FRAME, FAULT, VALID = "frame", "faulty frame", "valid frame"
"""The counters of every frame, of every faulty and of every valid one."""


def counters(protocol: Protocol, sent: Sent) -> tuple[str, ...]:
    """The counters that count a frame: those of all, of its outcome, of its kind and of its ID."""
    outcome = VALID if sent.kind in protocol.by_name else FAULT
    return FRAME, outcome, f"{sent.kind} frame", f"frame with ID {sent.identity}"


class Tally:
    """The frames since power-on; a power cycle begins it anew.

    `sent` has what is counted of each, `examples` one complete frame of each that differ in it,
    `places` those of the mismatches in cases, `cycles` how often the power was switched.
    """

    def __init__(self, protocol: Protocol, waiting: Waiting) -> None:
        self.sent: list[Sent] = []
        self.examples: dict[Sent, bytes] = {}
        self.places: list[Place] = []
        self.cycles = 0
        self._protocol = protocol
        self._waiting = waiting
        self._known: dict[bytes, Sent] = {}
        self._held = b""
        self._last = 0

    @property
    def frames(self) -> int:
        """How many frames there were."""
        return len(self.sent)

    def count(self, counter: str, frames: int | None = None) -> int:
        """How many of the first `frames` frames (all if None) this counter counts."""
        times = Counter(self.sent[:frames])
        return sum(n for one, n in times.items() if counter in counters(self._protocol, one))

    def did(self, operation: Operation, reply: Reply) -> None:
        """Take note of an operation that was done."""
        if isinstance(operation, Send) and isinstance(reply, int):
            self._last = reply
            self._held += operation.data
            self._split()
        elif isinstance(operation, PowerCycle):
            self.begin_anew()
        elif isinstance(reply, Received | Observation):
            self._silent_until(reply.now)

    def begin_anew(self) -> None:
        """Count from here on: the device was switched on, or may have been."""
        self.sent, self.places, self._held = [], [], b""
        self.cycles += 1

    def _silent_until(self, now: int) -> None:
        """End a truncated frame where nothing was sent for the time-out until `now` (ns)."""
        if self._held and now - self._last >= self._waiting.timeout:
            identity, _ = self._protocol.headers[self._held[0]]
            self._held = b""
            self.sent.append(Sent(FrameClass.TRUNCATED, identity))

    def _split(self) -> None:
        lengths = self._protocol.lengths
        while self._held and len(self._held) > lengths[self._held[0]]:
            end = 1 + lengths[self._held[0]]
            frame, self._held = self._held[:end], self._held[end:]
            sent = self._known.get(frame)
            if sent is None:
                step = complete_frame(self._protocol, frame[0], frame[1:])
                identity, _ = self._protocol.headers[frame[0]]
                sent = self._known[frame] = Sent(kind_of(self._protocol, step), identity)
                self.examples.setdefault(sent, frame)
            self.sent.append(sent)
