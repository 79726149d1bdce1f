"""The listeners of a run: their base class, the meter of its time, and the wire log of each case.

One of them measures where a run's time goes, and compares it with the time that it must take.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from operator import itemgetter

import msgspec

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
from bilprov.conformance.dut.target import Environment
from bilprov.conformance.oracle.judge import look_words
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict, WireEvent, WireKind
from bilprov.conformance.report.run_report import Report
from bilprov.spec.codec import spaced
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


# -- the wire log: bytes and looks of each case ---------------------------------------------------
# A case's log begins when the case does and ends when it is final, so that preamble and homing
# are in it. A device that floods does not fill the memory: the middle of a long log is left out,
# and the log says how much that was.
#
# Cases keep their logs, those that passed too: they are the evidence. A seeded sequence, which
# can be made again, keeps none where it was answered as it should be. In a case that passed,
# answers that came one after another with nothing between them are one entry, with the time of
# the first.


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
