"""Counts over a whole recording, kept up to date part by part; memory does not grow with it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.columns.decoder import Part
from bilprov.analyzer.columns.latencies import Latencies, Spread
from bilprov.analyzer.columns.stretch import Stretch
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record, serious_faults
from bilprov.spec.protocol import Protocol
from bilprov.spec.tables import OUTCOMES

SECOND = 1_000_000_000  # ns
_LATEST = 1 << 62  # ns; a latency beyond it can only be forged


class Totals:
    """Counts the parts of a recording.

    `kinds` counts host records (`instruction`, `truncated`, `garbage`), `host_bytes` and
    `device_bytes` their bytes. `first` and `last` are the times (ns) of the first and the last
    byte, None without any. `agreeing` and `disagreeing` count answers that are the expected one or
    not; for others nothing is expected. `faults` are anomalies by kind, without those of severity
    info. `peak` is the largest number of frames that ended in one second of the recording's clock.
    """

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._headers = np.zeros(256, np.int64)
        self._verdicts = np.zeros(len(OUTCOMES), np.int64)
        self._answers = np.zeros(256, np.int64)
        self._latencies = Latencies(protocol.timing)
        self._second, self._in_second = -1, 0
        self.kinds: Counter[str] = Counter()
        self.host_bytes = 0
        self.agreeing = 0
        self.disagreeing = 0
        self.faults: Counter[str] = Counter()
        self.first: int | None = None
        self.last: int | None = None
        self.peak = 0

    def add(self, part: Part) -> None:
        """Count a part, which follows those before it."""
        if isinstance(part, Stretch):
            self._add_stretch(part)
        else:
            self._add_records(part.listed)

    def merge(self, other: Totals) -> None:
        """Count another recording, of the same protocol; times are then without meaning."""
        self._headers += other._headers
        self._verdicts += other._verdicts
        self._answers += other._answers
        self._latencies.merge(other._latencies)
        self.kinds += other.kinds
        self.host_bytes += other.host_bytes
        self.agreeing += other.agreeing
        self.disagreeing += other.disagreeing
        self.faults += other.faults
        self.peak = max(self.peak, other.peak)

    @property
    def frames(self) -> int:
        """How many host frames there are, whole and truncated ones."""
        return int(self._verdicts.sum())

    @property
    def device_bytes(self) -> int:
        """How many bytes the device has sent."""
        return int(self._answers.sum())

    @property
    def latencies(self) -> Spread | None:
        """How the latencies of the answers are spread, None if nothing was paired."""
        return self._latencies.spread

    def instructions(self) -> dict[str, int]:
        """How many frames there are of each instruction of the grammar, and of each unused ID."""
        known = self._protocol.by_id
        found = dict.fromkeys((spec.name for spec in self._protocol.instructions), 0)
        for identity in self._protocol.ids:
            headers = [h for h, (one, _) in enumerate(self._protocol.headers) if one == identity]
            count = int(self._headers[headers].sum())
            if identity in known:
                found[known[identity].name] += count
            elif count:
                found[f"unused {identity}"] = count
        return found

    def expected(self) -> dict[str, int]:
        """How often each response is the one that a conforming device gives."""
        answers = self._protocol.answers
        counts = dict(zip(OUTCOMES, self._verdicts.tolist(), strict=True))
        return {spec.name: counts[spec.outcome] for spec in answers.values()}

    def responses(self) -> dict[str, int]:
        """How often the device has given each response, and each unused code."""
        codes = self._protocol.codes
        found = {spec.name: int(self._answers[code]) for code, spec in codes.items()}
        unused = (code for code in np.flatnonzero(self._answers).tolist() if code not in codes)
        return {**found, **{f"unused {code}": int(self._answers[code]) for code in unused}}

    def _add_stretch(self, stretch: Stretch) -> None:
        self.faults.update(stretch.fault_counts)
        new, rows = stretch.new, stretch.host_rows
        if rows:
            self._headers += np.bincount(new.key >> 8, minlength=256)
            self._verdicts += np.bincount(new.verdict, minlength=len(OUTCOMES))
            self.kinds["instruction"] += rows
            self.host_bytes += int(stretch.size[stretch.carried :].sum())
            end = stretch.end[stretch.carried :]
            self._heard(int(stretch.start[0]), int(end[-1]))
            self._ended(end)
        answers = len(stretch.byte)
        if answers:
            self._answers += np.bincount(stretch.byte, minlength=256)
            self._heard(int(stretch.t[0]), int(stretch.t[-1]))
            if stretch.decoding.paired:
                agreeing = int(np.count_nonzero(stretch.agrees))
                self.agreeing += agreeing
                self.disagreeing += answers - agreeing
                self._latencies.add(stretch.latency)
            else:  # then nothing is expected, but an unused code is never right
                known = np.array(list(self._protocol.codes), np.uint8)
                self.disagreeing += int(np.count_nonzero(~np.isin(stretch.byte, known)))

    def _ended(self, end: NDArray[np.int64]) -> None:
        """Count frames that ended at these times, which increase."""
        if end[0] // SECOND == end[-1] // SECOND:
            self._seconds([(int(end[0]) // SECOND, len(end))])
            return
        second = end // SECOND
        begun = np.flatnonzero(np.diff(second, prepend=-1))
        counts = np.diff(begun, append=len(end))
        self._seconds(zip(second[begun].tolist(), counts.tolist(), strict=True))

    def _seconds(self, counted: Iterable[tuple[int, int]]) -> None:
        for second, count in counted:
            if second != self._second:
                self._second, self._in_second = second, 0
            self._in_second += count
            self.peak = max(self.peak, self._in_second)

    def _heard(self, first: int, last: int) -> None:
        self.first = first if self.first is None else min(self.first, first)
        self.last = last if self.last is None else max(self.last, last)

    def _add_records(self, records: Sequence[Record]) -> None:
        latencies: list[int] = []
        for record in records:
            for fault in serious_faults(record) if record.faults else ():
                self.faults[fault.kind] += 1
            if isinstance(record, HostRecord):
                self._add_host(record)
            elif isinstance(record, DeviceRecord):
                self._heard(record.t, record.t)
                self._answers[record.byte] += 1
                self.agreeing += record.agrees is True
                self.disagreeing += record.agrees is False
                if record.latency is not None:
                    latencies.append(min(max(record.latency, -_LATEST), _LATEST))
        self._latencies.add(latencies)

    def _add_host(self, record: HostRecord) -> None:
        self._heard(record.t, record.end)
        self.kinds[record.kind] += 1
        self.host_bytes += len(record.data)
        if record.judgement:
            self._headers[record.data[0]] += 1
            self._verdicts[OUTCOMES.index(record.judgement.outcome)] += 1
            self._seconds([(record.end // SECOND, 1)])
