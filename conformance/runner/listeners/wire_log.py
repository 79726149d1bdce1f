"""Logs the bytes and looks of each case: the operations done over the link, and their replies.

A case's log begins when the case does and ends when it is final, so that preamble and homing are
in it. A device that floods does not fill the memory: the middle of a long log is left out, and the
log says how much that was.

Cases keep their logs, those that passed too: they are the evidence. A seeded sequence, which can
be made again, keeps none where it was answered as it should be. In a case that passed, answers that
came one after another with nothing between them are one entry, with the time of the first.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from operator import itemgetter

import msgspec

from bilprov.analyzer.client.operations import Ended, Observation, Operation, Received, Reply, Send
from bilprov.captures.schemas import Look
from bilprov.conformance.oracle.judge import look_words
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict, WireEvent, WireKind
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.spec.codec import spaced

HEAD = TAIL = 250
"""Entries that are kept from the begin and from the end of a case's log."""
WIDEST = 64
"""Bytes that are kept of one write or read."""


Entry = tuple[int, WireKind, bytes | str | Look]
"""The link's time (ns), the kind, and the bytes, words or look of an entry."""


class _Log:
    """The log of one case, its middle left out where it is too long."""

    def __init__(self) -> None:
        self._head: list[Entry] = []
        self._tail: deque[Entry] = deque(maxlen=TAIL)
        self._late = 0

    def add(self, entry: Entry) -> None:
        if len(self._head) < HEAD:
            self._head.append(entry)
        else:
            self._tail.append(entry)
            self._late += 1

    def entries(self) -> list[Entry]:
        """The entries that were kept, and one that says how many were not."""
        left_out = self._late - len(self._tail)
        if not left_out:
            return [*self._head, *self._tail]
        words = f"{left_out} entries are left out here"
        return [*self._head, (self._head[-1][0], "clipped", words), *self._tail]


class WireLog(RunListener):
    """Keeps the log of each case: the operations done over a link, and their replies."""

    def __init__(self) -> None:
        self._open: _Log | None = None
        self._logs: dict[str, _Log | list[Entry]] = {}

    def done(self, operation: Operation | None, reply: Reply | Ended) -> None:
        """Log one operation. Answers that came together are one entry."""
        if isinstance(reply, Received):
            for t, entries in groupby(reply.answers, key=itemgetter(0)):
                self._bytes("received", bytes([code for _, code in entries]), t)
        elif isinstance(reply, Observation):
            if self._open:
                self._open.add((reply.look.t, "look", reply.look))
        elif isinstance(operation, Send) and not isinstance(reply, Ended):
            self._bytes("sent", operation.data, reply)

    def begin(self, ident: str) -> None:
        """A case begins: what follows belongs to it. One that is tried again begins anew."""
        self._open = self._logs[ident] = _Log()

    def attached(self, result: CaseResult) -> CaseResult:
        """The result with its log: the case is final. One that never began has an empty log."""
        log = self._final(result.id)
        kept = [] if result.counted and result.verdict < Verdict.INCONCLUSIVE else log
        if result.verdict is Verdict.PASS:
            kept = list(_joined(kept))
        return msgspec.structs.replace(result, log=_events(kept))

    def of(self, ident: str) -> tuple[WireEvent, ...]:
        """The log of what began under this id; what comes later does not belong to it."""
        return _events(self._final(ident))

    def _final(self, ident: str) -> list[Entry]:
        log = self._logs.get(ident, [])
        if isinstance(log, _Log):
            log = self._logs[ident] = log.entries()
        return log

    def _bytes(self, kind: WireKind, data: bytes, t: int) -> None:
        if not self._open:
            return
        self._open.add((t, kind, data[:WIDEST]))
        if len(data) > WIDEST:
            words = f"{len(data) - WIDEST} bytes more are left out here"
            self._open.add((t, "clipped", words))


def _joined(log: Iterable[Entry]) -> Iterator[Entry]:
    """The log with answers that follow each other joined to one entry, at the first one's time."""
    for kind, entries in groupby(log, key=itemgetter(1)):
        if kind == "received":
            joined = list(entries)
            data = b"".join(what for _, _, what in joined if isinstance(what, bytes))
            yield joined[0][0], kind, data
        else:
            yield from entries


def _events(log: Sequence[Entry]) -> tuple[WireEvent, ...]:
    """The log for a report: bytes as hex, times counted from the first entry."""
    start = log[0][0] if log else 0
    return tuple(WireEvent(max(t - start, 0) / 1e9, kind, *_told(what)) for t, kind, what in log)


def _told(what: bytes | str | Look) -> tuple[str, str]:
    """What an entry is about: its bytes as hex, and words."""
    if isinstance(what, bytes):
        return spaced(what), ""
    return "", what if isinstance(what, str) else look_words(what)
