"""The base class of what listens to a run, and the link that tells the listeners what passes.

One of them measures where a run's time goes, and compares it with the time that it must take.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence

from bilprov.analyzer.client.operations import (
    Ended,
    Link,
    LinkListener,
    Listen,
    Observation,
    Operation,
    Received,
    Reply,
    Send,
)
from bilprov.captures.schemas import Look
from bilprov.conformance.dut.link import Environment
from bilprov.conformance.oracle.verdicts import CaseResult
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol


class RunListener(LinkListener):
    """A listener to a run: each method is told one kind of event, and does nothing here.

    Times are in ns on the link's clock. `broken` says why a listener cannot go on, None while it
    can: the run then ends early, with the robot homed.
    """

    broken: Exception | None = None

    def begins(self, protocol: Protocol, options: object, environment: Environment) -> None:
        """The run begins; nothing has been sent yet."""

    def done(self, operation: Operation | None, reply: Reply | Ended) -> None:
        """An operation was done or failed; None stands for an interruption of the run."""

    def did(self, operation: Operation, reply: Reply) -> None:
        """An operation of a procedure that is followed was done."""
        self.done(operation, reply)

    def begin(self, ident: str) -> None:
        """A case begins."""

    def end(self, result: CaseResult) -> None:
        """A case is final."""

    def note(self, sentence: str) -> None:
        """Something that the user should know while the run goes on."""

    def reported(self, report: Report) -> None:
        """The run is over; this is its report."""


class ObservedLink(LinkListener):
    """A link that tells the listeners each operation, and the bytes and looks that pass."""

    def __init__(
        self, connect: Callable[[LinkListener], Link], listeners: Sequence[RunListener]
    ) -> None:
        self._listeners = listeners
        self._link = connect(self)

    def do(self, operation: Operation) -> Reply:
        """Do one operation. Raises Ended when it could not be done."""
        try:
            reply = self._link.do(operation)
        except Ended as ended:
            self.done(operation, ended)
            raise
        self.done(operation, reply)
        return reply

    def done(self, operation: Operation | None, reply: Reply | Ended) -> None:
        """An operation was done or failed; None stands for an interruption of the run."""
        for listener in self._listeners:
            listener.done(operation, reply)

    def sent(self, data: bytes, t: int) -> None:
        """Bytes that go to the device."""
        for listener in self._listeners:
            listener.sent(data, t)

    def received(self, data: bytes, t: int) -> None:
        """Bytes that came from it."""
        for listener in self._listeners:
            listener.received(data, t)

    def looked(self, look: Look) -> None:
        """A reading of the probe."""
        for listener in self._listeners:
            listener.looked(look)


class Meter(RunListener):
    """Counts bytes, silences and looks of a run; `byte_time` and the replies' times are in ns."""

    def __init__(self, byte_time: int) -> None:
        self._byte_time = byte_time
        self._sent = self._received = 0
        self._silences = 0
        self._looks: list[int] = []
        self._first: int | None = None
        self._last = 0

    def done(self, operation: Operation | None, reply: Reply | Ended) -> None:
        """Count one operation, unless it failed."""
        if isinstance(reply, Ended):
            return
        before = self._last
        if isinstance(reply, Received):
            self._last = reply.now
            self._received += len(reply.answers)
            if isinstance(operation, Listen) and operation.count is None:
                self._silences += operation.patience
            elif isinstance(operation, Listen) and len(reply.answers) < (operation.count or 0):
                self._silences += max(0, reply.now - before)
        elif isinstance(reply, Observation):
            self._last = reply.now
            self._looks.append(reply.now - reply.asked)
        else:
            self._last = reply
            self._sent += len(operation.data) if isinstance(operation, Send) else 0
        if self._first is None:
            self._first = before or self._last

    def report(self, timeouts: int) -> dict[str, float]:
        """The counts, with times in s and ms; `timeouts` is the wait (ns) for truncated frames.

        `ratio` is the time the run took divided by the time it must take: every byte on the wire,
        the silences it declares, the time-outs it waits for, and its looks, each at their median.
        """
        look = statistics.median(self._looks) if self._looks else 0.0
        wire = (self._sent + self._received) * self._byte_time
        arithmetic = wire + self._silences + timeouts + len(self._looks) * look
        took = self._last - (self._first or 0)
        return {
            "bytes_sent": self._sent,
            "bytes_received": self._received,
            "wire_s": round(wire / 1e9, 3),
            "silences_s": round(self._silences / 1e9, 3),
            "timeouts_s": round(timeouts / 1e9, 3),
            "looks": len(self._looks),
            "look_ms": round(look / 1e6, 3),
            "took_s": round(took / 1e9, 3),
            "ratio": round(took / arithmetic, 3) if arithmetic else 0.0,
        }
