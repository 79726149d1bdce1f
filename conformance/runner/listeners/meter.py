"""Measures where a run's time goes, and holds it against what arithmetic says it must take."""

from __future__ import annotations

import statistics

from conformance.dut.link import Link
from conformance.dut.operations import Ask, Heard, Listen, Seen, Send


class Meter:
    """Counts bytes, silences and looks of a link; all times come from its replies (ns)."""

    def __init__(self, byte_time: int) -> None:
        self._byte_time = byte_time
        self._sent = self._received = 0
        self._silences = 0
        self._looks: list[int] = []
        self._first: int | None = None
        self._last = 0

    def over(self, link: Link) -> Link:
        """The same link, measured."""
        return _Metered(link, self)

    def told(self, ask: Ask, reply: int | Heard | Seen) -> None:
        """An ask was done."""
        before = self._last
        if isinstance(reply, Heard):
            self._last = reply.now
            self._received += len(reply.answers)
            if isinstance(ask, Listen) and ask.count is None:
                self._silences += ask.patience
            elif isinstance(ask, Listen) and len(reply.answers) < (ask.count or 0):
                self._silences += max(0, reply.now - before)
        elif isinstance(reply, Seen):
            self._last = reply.now
            self._looks.append(reply.now - reply.asked)
        else:
            self._last = reply
            self._sent += len(ask.data) if isinstance(ask, Send) else 0
        if self._first is None:
            self._first = before or self._last

    def report(self, timeouts: int) -> dict[str, float]:
        """What was counted, in s and ms; `timeouts` (ns) were waited for frames that are cut short.

        `ratio` is the time that the run took by what it must take: every byte on the wire, the
        silences it declares, the time-outs it waits for, and its looks at what one usually takes.
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


class _Metered:
    def __init__(self, link: Link, meter: Meter) -> None:
        self._link = link
        self._meter = meter

    def do(self, ask: Ask) -> int | Heard | Seen:
        """Do one ask and measure it. Raises Ended when it could not be done."""
        reply = self._link.do(ask)
        self._meter.told(ask, reply)
        return reply
