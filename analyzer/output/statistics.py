"""Counts and rates of a session. `batch` is cheap, since all traffic passes through it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bilprov.captures.schemas import Chunk, Line

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch

WINDOW = 2_000_000_000  # ns that rates are taken over
_BUCKET = 250_000_000  # ns


@dataclass(frozen=True, slots=True)
class Rates:
    """Frames per second, and bytes per second of host and device, over the last two seconds."""

    frames: float
    bytes: tuple[float, float]


class Statistics:
    """Counts the events and the decoded rows of a session.

    `instructions` counts the whole and the truncated ones, `responses` the device bytes, `faults`
    the anomalies without those of severity info.
    """

    def __init__(self) -> None:
        self.instructions = 0
        self.responses = 0
        self.faults = 0
        self._frames = _Rate()
        self._bytes = {"host": _Rate(), "device": _Rate()}

    def events(self, events: Iterable[Chunk | Line]) -> None:
        """Count the bytes of events."""
        for event in events:
            if isinstance(event, Chunk):
                self._bytes[event.direction].add(event.t, len(event.data))

    def batch(self, batch: Batch, now: int) -> None:
        """Count a batch that was complete at `now` (ns)."""
        frames, answers, faults = batch.counts
        self.instructions += frames
        self.responses += answers
        self.faults += faults
        if frames:
            self._frames.add(now, frames)

    def rates(self, now: int) -> Rates:
        """The rates at `now` (ns since the start)."""
        sides = self._bytes["host"].value(now), self._bytes["device"].value(now)
        return Rates(self._frames.value(now), sides)


class _Rate:
    """Amounts per second over a sliding window, in buckets of a quarter of a second."""

    def __init__(self) -> None:
        self._buckets: deque[list[int]] = deque()

    def add(self, t: int, amount: int) -> None:
        number = t // _BUCKET
        if self._buckets and self._buckets[-1][0] >= number:
            self._buckets[-1][1] += amount
        else:
            self._buckets.append([number, amount])
            self._drop(number)

    def value(self, now: int) -> float:
        self._drop(now // _BUCKET)
        span = min(WINDOW, max(now, _BUCKET))
        return sum(amount for _, amount in self._buckets) * 1e9 / span

    def _drop(self, newest: int) -> None:
        while self._buckets and self._buckets[0][0] <= newest - WINDOW // _BUCKET:
            self._buckets.popleft()
