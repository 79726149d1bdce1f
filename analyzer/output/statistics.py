"""Counts, rates and latencies of a session, and frozen snapshots of them.

`record` is cheap, since it is called for each record; `snapshot` sorts and sums, for the screen.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

from bilprov.analyzer.decode.records import (
    Anomaly,
    DeviceRecord,
    HostRecord,
    Record,
    serious_faults,
    written_state,
)
from bilprov.captures.schemas import Chunk, Line, State
from bilprov.spec.protocol import Protocol

KEPT_RECORDS = 100
KEPT_FAULTS = 20
KEPT_LATENCIES = 4096
WINDOW = 2_000_000_000  # ns that rates are taken over
_BUCKET = 250_000_000  # ns


@dataclass(frozen=True, slots=True)
class Latencies:
    """Median, 95th percentile (both of the last 4,096) and the longest so far, in ns."""

    median: int
    ninety_fifth: int
    longest: int


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The statistics at one time, `t` (ns since the start).

    Rates are per second, over the last two seconds; `loads` is the share of the line's capacity
    that host and device use, 0 to 1. `faults` counts anomalies by kind, without those of severity
    info.
    """

    t: int
    instructions: int
    responses: int
    host_bytes: int
    device_bytes: int
    frame_rate: float
    byte_rates: tuple[float, float]
    loads: tuple[float, float]
    latencies: Latencies | None
    faults: tuple[tuple[str, int], ...]
    recent: tuple[Record, ...]
    recent_faults: tuple[Anomaly, ...]
    state: State


class Statistics:
    """Counts the events and records of a session. `byte_time` is ns per byte on the line.

    `instructions` counts the whole and the truncated ones, `responses` the device bytes.
    """

    def __init__(self, protocol: Protocol, byte_time: int) -> None:
        self._byte_time = byte_time
        self.instructions = 0
        self.responses = 0
        self._bytes = {"host": 0, "device": 0}
        self._frames = _Rate()
        self._byte_rates = {"host": _Rate(), "device": _Rate()}
        self._latencies: deque[int] = deque(maxlen=KEPT_LATENCIES)
        self._longest = 0
        self._faults: Counter[str] = Counter()
        self._recent: deque[Record] = deque(maxlen=KEPT_RECORDS)
        self._recent_faults: deque[Anomaly] = deque(maxlen=KEPT_FAULTS)
        self._state = written_state(protocol.power_on)

    @property
    def fault_count(self) -> int:
        """The number of anomalies, without those of severity info."""
        return self._faults.total()

    def event(self, event: Chunk | Line) -> None:
        """Count the bytes of an event."""
        if isinstance(event, Chunk):
            self._bytes[event.direction] += len(event.data)
            self._byte_rates[event.direction].add(event.t, len(event.data))

    def record(self, record: Record, *, shown: bool = True) -> None:
        """Count a record; only one that is `shown` (a filter may hide it) is listed."""
        self._state = record.state
        if isinstance(record, HostRecord):
            self.instructions += record.judgement is not None
            self._frames.add(record.end, 1)
        elif isinstance(record, DeviceRecord):
            self.responses += 1
            latency = record.latency
            if latency is not None:
                self._latencies.append(latency)
                self._longest = max(self._longest, latency)
        if shown:
            self._recent.append(record)
        for fault in serious_faults(record) if record.faults else ():
            self._faults[fault.kind] += 1
            self._recent_faults.append(fault)

    def snapshot(self, now: int) -> Snapshot:
        """Return the statistics at `now` (ns since the start)."""
        rates = (self._byte_rates["host"].value(now), self._byte_rates["device"].value(now))
        return Snapshot(
            t=now,
            instructions=self.instructions,
            responses=self.responses,
            host_bytes=self._bytes["host"],
            device_bytes=self._bytes["device"],
            frame_rate=self._frames.value(now),
            byte_rates=rates,
            loads=(rates[0] * self._byte_time / 1e9, rates[1] * self._byte_time / 1e9),
            latencies=self._latency_values(),
            faults=tuple(self._faults.most_common()),
            recent=tuple(self._recent),
            recent_faults=tuple(self._recent_faults),
            state=self._state,
        )

    def _latency_values(self) -> Latencies | None:
        if not self._latencies:
            return None
        ordered = sorted(self._latencies)
        return Latencies(
            median=ordered[len(ordered) // 2],
            ninety_fifth=ordered[len(ordered) * 95 // 100],
            longest=self._longest,
        )


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
