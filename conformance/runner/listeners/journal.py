"""Everything that the runner got as a reply is told to a journal, so that it can be replayed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from conformance.dut.link import Link, Tap, interruption
from conformance.dut.operations import Ask, Heard, Seen
from conformance.report.run_report import Report
from conformance.runner.environment import Circumstances
from conformance.runner.run import Ended
from spec.protocol import Protocol as Grammar


@runtime_checkable
class Journal(Tap, Protocol):
    """A tap that keeps also what the run rests on, when each ask was done, and the report."""

    def begins(self, grammar: Grammar, options: object, circumstances: Circumstances) -> None:
        """The run begins; nothing was sent yet."""

    def asked(self, ask: Ask | None, reply: int | Heard | Seen | Ended) -> None:
        """An ask was done, or could not be; without one the run is told to end."""

    def reported(self, report: Report) -> None:
        """The run is over, and this is what came out."""


def journalled(
    link: Link, interrupted: Callable[[], bool | str], journal: Journal
) -> tuple[Link, Callable[[], bool | str]]:
    """The same link and the same question, with a journal that hears of both."""

    def asked() -> bool | str:
        why = interrupted()
        if why:
            journal.asked(None, interruption(why))
        return why

    return _Journalled(link, journal), asked


class _Journalled:
    def __init__(self, link: Link, journal: Journal) -> None:
        self._link = link
        self._journal = journal

    def do(self, ask: Ask) -> int | Heard | Seen:
        """Do one ask and tell how it went. Raises Ended when it could not be done."""
        try:
            reply = self._link.do(ask)
        except Ended as ended:
            self._journal.asked(ask, ended)
            raise
        self._journal.asked(ask, reply)
        return reply
