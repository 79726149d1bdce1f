"""Passes every operation of the runner and its reply to a journal, so that they can be replayed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from bilprov.conformance.dut.link import Link, LinkListener, interruption
from bilprov.conformance.dut.operations import Ended, Observation, Operation, Received
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.environment import Environment
from bilprov.spec.protocol import Protocol as Grammar


@runtime_checkable
class RunJournal(LinkListener, Protocol):
    """A link listener that is also told the run's environment, each operation, and the report."""

    def begins(self, grammar: Grammar, options: object, environment: Environment) -> None:
        """The run begins; nothing has been sent yet."""

    def asked(
        self, operation: Operation | None, reply: int | Received | Observation | Ended
    ) -> None:
        """An operation was done or failed; None stands for an interruption of the run."""

    def reported(self, report: Report) -> None:
        """The run is over; this is its report."""


def journalled(
    link: Link, interrupted: Callable[[], bool | str], journal: RunJournal
) -> tuple[Link, Callable[[], bool | str]]:
    """The link and `interrupted`, both wrapped so that the journal is told of each use."""

    def asked() -> bool | str:
        why = interrupted()
        if why:
            journal.asked(None, interruption(why))
        return why

    return _Journalled(link, journal), asked


class _Journalled:
    def __init__(self, link: Link, journal: RunJournal) -> None:
        self._link = link
        self._journal = journal

    def do(self, operation: Operation) -> int | Received | Observation:
        """Do one operation and tell the journal. Raises Ended when it could not be done."""
        try:
            reply = self._link.do(operation)
        except Ended as ended:
            self._journal.asked(operation, ended)
            raise
        self._journal.asked(operation, reply)
        return reply
