"""Measures where a run's time goes and compares it with the time it must take by arithmetic."""

from __future__ import annotations

import statistics

from bilprov.analyzer.client.operations import (
    Ended,
    Listen,
    Observation,
    Operation,
    Received,
    Reply,
    Send,
)
from bilprov.conformance.runner.listeners.listener import RunListener


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
