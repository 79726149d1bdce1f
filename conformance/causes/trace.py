"""The trace of a run: every operation with its reply, and the cases that they belong to."""

from __future__ import annotations

from typing import NamedTuple

import msgspec

from bilprov.analyzer.client.operations import Ended, Observation, Operation, Received, Reply
from bilprov.captures.schemas import Look
from bilprov.conformance.oracle.verdicts import CaseResult
from bilprov.conformance.runner.listeners.listener import RunListener

_MOST = 1 << 10  # answers kept of one operation: a flood must not fill the memory


class Done(NamedTuple):
    """An operation that was done, or failed, with its reply; None stands for an interruption."""

    operation: Operation | None
    reply: Reply | Ended


class Mark(NamedTuple):
    """A case began or, `over`, is final, as one too that was concluded without a beginning."""

    ident: str
    over: bool


Event = Done | Mark


class Trace(RunListener):
    """Keeps what passed over the link in a run, in order; `now` is when the last was done (ns)."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.now = 0
        self._look: Look | None = None
        self._facets: tuple[object, ...] = ()

    def done(self, operation: Operation | None, reply: Reply | Ended) -> None:
        """Keep one operation; a look that shows what the last one showed shares its memory."""
        self.now = reply if isinstance(reply, int) else getattr(reply, "now", self.now)
        if isinstance(reply, Received) and len(reply.answers) > _MOST:
            reply = Received(reply.answers[:_MOST], reply.now)
        if isinstance(reply, Observation):
            facets = msgspec.structs.astuple(reply.look)[1:]
            if self._look is None or facets != self._facets:
                self._look, self._facets = reply.look, facets
            reply = Observation(reply.asked, reply.now, self._look)
        self.events.append(Done(operation, reply))

    def begin(self, ident: str) -> None:
        """A case begins."""
        self.events.append(Mark(ident, over=False))

    def end(self, result: CaseResult) -> None:
        """A case is final."""
        self.events.append(Mark(result.id, over=True))
