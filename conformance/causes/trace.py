"""The trace of a run: every byte, answer, look and power cycle, and the case it belongs to."""

from __future__ import annotations

from typing import NamedTuple

import msgspec

from bilprov.analyzer.client.operations import (
    Ended,
    Observation,
    Operation,
    PowerCycle,
    Received,
    Reply,
    Send,
)
from bilprov.captures.schemas import Look
from bilprov.conformance.oracle.verdicts import CaseResult
from bilprov.conformance.runner.listeners.listener import RunListener


class Sent(NamedTuple):
    """Bytes that were sent in one go; `t` is when the last one had gone (ns)."""

    t: int
    data: bytes


class Heard(NamedTuple):
    """One answer byte and when it came (ns)."""

    t: int
    code: int


class Seen(NamedTuple):
    """A look at the device, and when the probe was asked for it (ns)."""

    t: int
    look: Look


class Begun(NamedTuple):
    """A case began."""

    ident: str


class Concluded(NamedTuple):
    """A case is final, one too that a procedure of the runner concluded without beginning it."""

    ident: str


class Silent(NamedTuple):
    """Listening ended at `t` (ns)."""

    t: int


class PoweredOn(NamedTuple):
    """The device was switched off and on, or its port was lost and found again."""

    t: int


Event = Sent | Heard | Seen | Begun | Concluded | Silent | PoweredOn


class Trace(RunListener):
    """Keeps what passed over the link in a run, in order; `now` is when the last was done (ns)."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.now = 0
        self._look: Look | None = None

    def done(self, operation: Operation | None, reply: Reply | Ended) -> None:
        """Keep one operation; one that failed leaves nothing that could be judged."""
        self.now = reply if isinstance(reply, int) else getattr(reply, "now", self.now)
        if isinstance(reply, Received):
            self.events += [Heard(t, code) for t, code in reply.answers]
            self.events.append(Silent(reply.now))
        elif isinstance(reply, Observation):
            self._seen(reply.asked, reply.look)
        elif isinstance(reply, int) and isinstance(operation, Send):
            self.events.append(Sent(reply, operation.data))
        elif isinstance(reply, int) and isinstance(operation, PowerCycle):
            self.events.append(PoweredOn(reply))
        elif isinstance(reply, Ended):
            self.events.append(PoweredOn(0))

    def _seen(self, asked: int, look: Look) -> None:
        """Keep a look; one that shows what the last one showed shares its memory."""
        same = self._look is not None and _facets(self._look) == _facets(look)
        self._look = self._look if same and self._look is not None else look
        self.events.append(Seen(asked, self._look))

    def begin(self, ident: str) -> None:
        """A case begins."""
        self.events.append(Begun(ident))

    def end(self, result: CaseResult) -> None:
        """A case is final."""
        self.events.append(Concluded(result.id))


def _facets(look: Look) -> tuple[object, ...]:
    return msgspec.structs.astuple(look)[1:]
