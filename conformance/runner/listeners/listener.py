"""The base class of what listens to a run, and the link that tells the listeners what passes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from bilprov.analyzer.client.operations import Ended, Link, LinkListener, Operation, Reply
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
