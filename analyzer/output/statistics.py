"""Counts, rates and latencies of a session, and frozen snapshots of them.

`part` is cheap, since all traffic passes through it; `snapshot` sorts and sums, for the screen.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bilprov.analyzer.columns.decoder import Part, Records
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

if TYPE_CHECKING:
    from bilprov.analyzer.columns.stretch import Stretch

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
    that host and device use, 0 to 1. `faults` counts anomalies by kind, the most frequent
    first, without those of severity info.
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
        # The newest parts that were shown, and those with anomalies: as many as a view may need.
        self._recent = _Newest(KEPT_RECORDS)
        self._faulty = _Newest(KEPT_FAULTS)
        self._state = written_state(protocol.power_on)

    @property
    def fault_count(self) -> int:
        """The number of anomalies, without those of severity info."""
        return self._faults.total()

    def events(self, events: Iterable[Chunk | Line]) -> None:
        """Count the bytes of events."""
        for event in events:
            if isinstance(event, Chunk):
                self._bytes[event.direction] += len(event.data)
                self._byte_rates[event.direction].add(event.t, len(event.data))

    def part(self, part: Part, shown: Part) -> None:
        """Count a part; only what is `shown` of it (a filter may hide some) is listed."""
        self._recent.add(shown, shown.rows)
        if isinstance(part, Records):
            self._records(part.listed)
        else:
            self._stretch(part)

    def _records(self, records: Sequence[Record]) -> None:
        """Count records; this is done for each frame of a line that is not very busy."""
        latencies: list[int] = []
        faulty: list[Record] = []
        for record in records:
            if type(record) is DeviceRecord:
                self.responses += 1
                if record.latency is not None:
                    latencies.append(record.latency)
                if record.faults:
                    faulty.append(record)
            elif type(record) is HostRecord:
                self._frames.add(record.end, 1)
                self.instructions += record.sequence is not None
                if record.reason:
                    faulty.append(record)
            else:
                faulty.append(record)
        if not records:
            return
        self._state = records[-1].state
        if latencies:
            self._latencies.extend(latencies)
            self._longest = max(self._longest, *latencies)
        for record in faulty:
            found = serious_faults(record)
            if found:
                self._faults.update(fault.kind for fault in found)
                self._faulty.add(Records([record]), len(found))

    def _stretch(self, stretch: Stretch) -> None:
        self._state = stretch.last
        self.instructions += stretch.host_rows
        for t, frames in stretch.frame_counts():
            self._frames.add(t, frames)
        self.responses += len(stretch.t)
        if stretch.decoding.paired and len(stretch.t):
            self._latencies.extend(stretch.latency[-KEPT_LATENCIES:].tolist())
            self._longest = max(self._longest, int(stretch.latency.max()))
        from bilprov.analyzer.columns.kinds import fault_counts  # it needs numpy

        found = fault_counts(stretch)
        found.update(
            fault.kind
            for at in range(len(stretch.lines))
            for fault in serious_faults(stretch.line(at, stretch.carried))
        )
        if found:
            self._faults += found
            self._faulty.add(stretch, found.total())

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
            faults=tuple(sorted(self._faults.items(), key=lambda item: (-item[1], item[0]))),
            recent=self._recent.records(),
            recent_faults=self._anomalies(),
            state=self._state,
        )

    def _anomalies(self) -> tuple[Anomaly, ...]:
        found = [fault for record in self._faulty.faulty() for fault in serious_faults(record)]
        return tuple(found[-KEPT_FAULTS:])

    def _latency_values(self) -> Latencies | None:
        if not self._latencies:
            return None
        ordered = sorted(self._latencies)
        return Latencies(
            median=ordered[len(ordered) // 2],
            ninety_fifth=ordered[len(ordered) * 95 // 100],
            longest=self._longest,
        )


class _Newest:
    """The newest parts that together have at least `most` of what is counted."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._parts: deque[tuple[Part, int]] = deque()
        self._count = 0

    def add(self, part: Part, count: int) -> None:
        if not count:  # such parts would never be too many
            return
        self._parts.append((part, count))
        self._count += count
        while self._count - self._parts[0][1] >= self._most:
            self._count -= self._parts.popleft()[1]

    def records(self) -> tuple[Record, ...]:
        """The newest records."""
        listed = [record for part, _ in self._parts for record in part.newest(self._most)]
        return tuple(listed[-self._most :])

    def faulty(self) -> Iterator[Record]:
        """The newest records with anomalies."""
        for part, _ in self._parts:
            yield from part.newest_faulty(self._most)


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
