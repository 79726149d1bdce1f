"""Counts over a whole recording, kept up to date part by part; memory does not grow with it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import compress
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.columns.decoder import Part, Records
from bilprov.analyzer.columns.kinds import Kinds, device_kinds, host_kinds
from bilprov.analyzer.columns.latencies import Latencies, Spread
from bilprov.analyzer.columns.moving import MovingTime
from bilprov.analyzer.columns.rates import SECOND, Rates
from bilprov.analyzer.columns.stretch import Stretch
from bilprov.analyzer.decode.records import (
    DeviceRecord,
    HostRecord,
    LineRecord,
    Record,
    serious_faults,
)
from bilprov.spec.protocol import Protocol
from bilprov.spec.tables import OUTCOMES

_LATEST = 1 << 62  # ns; a time or a latency beyond it can only be forged
SERIES = ("frames", "faults", "host_bytes", "device_bytes")
"""What is counted by time, each frame when it ended."""

Mask: TypeAlias = NDArray[np.bool_]


class Chosen(NamedTuple):
    """Which new host rows, device rows and line events of a Stretch are counted."""

    host: Mask
    device: Mask
    lines: Sequence[bool]


class Instruction(NamedTuple):
    """Counts of one instruction, or of all with one unused ID.

    `frames` are the whole and the truncated ones, `responses` the answers by name, `faults` the
    anomalies of both by kind, without those of severity info.
    """

    frames: int
    responses: dict[str, int]
    faults: dict[str, int]
    latencies: Spread | None


class Totals:
    """Counts the parts of a recording.

    `kinds` counts host records (`instruction`, `truncated`, `garbage`), `host_bytes` and
    `device_bytes` their bytes. `first` and `last` are the times (ns) of the first and the last
    byte, None without any; in between the wheels turn for `moving` (ns), as is predicted.
    `agreeing` and `disagreeing` count answers that are the expected one or not; for others nothing
    is expected. `peak` is the largest number of frames that ended in one second of the recording's
    clock, `rates` has `SERIES` by time. Anomalies are counted without those of severity info.
    """

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._ids = np.array([identity for identity, _ in protocol.headers], np.int64)
        self._headers = np.zeros(256, np.int64)
        self._verdicts = np.zeros(len(OUTCOMES), np.int64)
        self._answers = np.zeros(256, np.int64)
        self._paired = np.zeros((len(protocol.ids), 256), np.int64)  # by ID and byte of the answer
        self._latencies = Latencies(protocol.timing, len(protocol.ids))
        self._faults: Counter[tuple[str, int | None, str]] = Counter()  # direction, ID, kind
        self._moving = MovingTime(protocol.power_on.moving)
        self._moved_before: int | None = None  # ns that the wheels had turned at `first`
        self._second, self._in_second = -1, 0
        self.rates = Rates(*SERIES)
        self.kinds: Counter[str] = Counter()
        self.host_bytes = 0
        self.agreeing = 0
        self.disagreeing = 0
        self.first: int | None = None
        self.last: int | None = None
        self.moving = 0
        self.peak = 0

    def add(self, part: Part, chosen: Chosen | Sequence[bool] | None = None) -> None:
        """Count a part, which follows those before it.

        Only what is `chosen` of a Stretch, or of the records in their order; None for all.
        """
        if isinstance(part, Records):
            assert not isinstance(chosen, Chosen)
            records = part.listed if chosen is None else list(compress(part.listed, chosen))
            heard = self._add_records(records)
            hosts = [record for record in part.listed if isinstance(record, HostRecord)]
            t = np.array([min(record.known, _LATEST) for record in hosts], np.int64)
            self._follow(t, np.array([record.state.moving for record in hosts], np.bool_), heard)
        else:
            assert chosen is None or isinstance(chosen, Chosen)
            heard = self._add_stretch(part, chosen)
            self._follow(part.end[part.carried :], part.moving, heard)

    def merge(self, other: Totals) -> None:
        """Count another recording, of the same protocol; times and rates have no meaning then."""
        self._headers += other._headers
        self._verdicts += other._verdicts
        self._answers += other._answers
        self._paired += other._paired
        self._latencies.merge(other._latencies)
        self._faults += other._faults
        self.kinds += other.kinds
        self.host_bytes += other.host_bytes
        self.agreeing += other.agreeing
        self.disagreeing += other.disagreeing
        self.moving += other.moving
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
    def latencies(self) -> Latencies:
        """The latencies of the answers."""
        return self._latencies

    @property
    def faults(self) -> Counter[str]:
        """Anomalies by kind."""
        return self._fault_counts()

    def faults_of(self, direction: str) -> Counter[str]:
        """Anomalies by kind of one direction (`host`, `device`), or of neither ("")."""
        return self._fault_counts(direction=direction)

    def instructions(self) -> dict[str, Instruction]:
        """The counts of each instruction of the grammar, and of each unused ID that occurs."""
        return {name: self._instruction(identity) for identity, name in self._named_ids()}

    def expected(self) -> dict[str, int]:
        """How often each response is the one that a conforming device gives."""
        answers = self._protocol.answers
        counts = dict(zip(OUTCOMES, self._verdicts.tolist(), strict=True))
        return {spec.name: counts[spec.outcome] for spec in answers.values()}

    def responses(self) -> dict[str, int]:
        """How often the device has given each response, and each unused code."""
        codes = self._protocol.codes
        known = dict.fromkeys((spec.name for spec in codes.values()), 0)
        return {**known, **self._by_response(self._answers)}

    def _by_response(self, counts: NDArray[np.int64]) -> dict[str, int]:
        """Those that are not 0 of some counts by byte, the codes of the grammar first."""
        codes = self._protocol.codes
        used = [code for code in codes if counts[code]]
        unused = [code for code in np.flatnonzero(counts).tolist() if code not in codes]
        named = {codes[code].name: int(counts[code]) for code in used}
        return {**named, **{f"unused {code}": int(counts[code]) for code in unused}}

    def _named_ids(self) -> Iterator[tuple[int, str]]:
        for spec in self._protocol.instructions:
            yield spec.id, spec.name
        for identity in self._protocol.unused_ids:
            if self._headers[self._ids == identity].any():
                yield identity, f"unused {identity}"

    def _instruction(self, identity: int) -> Instruction:
        return Instruction(
            frames=int(self._headers[self._ids == identity].sum()),
            responses=self._by_response(self._paired[identity]),
            faults=dict(self._fault_counts(identity=identity).most_common()),
            latencies=self._latencies.spread(identity),
        )

    def _fault_counts(
        self, direction: str | None = None, identity: int | None = None
    ) -> Counter[str]:
        counts: Counter[str] = Counter()
        for (side, about, kind), count in self._faults.items():
            if direction in (None, side) and identity in (None, about):
                counts[kind] += count
        return counts

    # -- a stretch ---------------------------------------------------------------------------------

    def _add_stretch(self, stretch: Stretch, chosen: Chosen | None) -> list[int]:
        """Count what is chosen of a stretch; returns the times (ns) of its ends."""
        # None of their states is asked for, so that no state is ever worked out.
        lines = [
            stretch.line(at, stretch.carried)
            for at in range(len(stretch.lines))
            if chosen is None or chosen.lines[at]
        ]
        heard = self._add_records(lines)
        heard += self._add_hosts(stretch, None if chosen is None else np.flatnonzero(chosen.host))
        heard += self._add_devices(
            stretch, None if chosen is None else np.flatnonzero(chosen.device)
        )
        return heard

    def _add_hosts(self, stretch: Stretch, rows: NDArray[np.int64] | None) -> list[int]:
        header, verdict, kinds = stretch.new.key >> 8, stretch.new.verdict, host_kinds(stretch)
        start, end = stretch.start, stretch.end[stretch.carried :]
        size = stretch.size[stretch.carried :]
        if rows is not None:
            header, verdict, size = header[rows], verdict[rows], size[rows]
            start, end, kinds = start[rows], end[rows], kinds._replace(code=kinds.code[rows])
        if not len(header):
            return []
        self._headers += np.bincount(header, minlength=256)
        self._verdicts += [np.count_nonzero(verdict == place) for place in range(len(OUTCOMES))]
        self.kinds["instruction"] += len(header)
        self.host_bytes += int(size.sum())
        self.rates.count("frames", end)
        self.rates.count("host_bytes", end, size)
        self._ended(end)
        self._add_kinds("host", kinds, end, header)
        return [int(start[0]), int(end[-1])]

    def _add_devices(self, stretch: Stretch, rows: NDArray[np.int64] | None) -> list[int]:
        byte, t, kinds = stretch.byte, stretch.t, device_kinds(stretch)
        chosen: slice | NDArray[np.int64] = slice(None) if rows is None else rows
        if rows is not None:
            byte, t, kinds = byte[rows], t[rows], kinds._replace(code=kinds.code[rows])
        if not len(byte):
            return []
        self.rates.count("device_bytes", t)
        if not stretch.decoding.paired:
            # Then nothing is expected, but an unused code is never right.
            self._answers += np.bincount(byte, minlength=256)
            self.disagreeing += int(np.count_nonzero(~stretch.fits[chosen]))
            self._add_kinds("device", kinds, t, None)
            return [int(t[0]), int(t[-1])]
        agreeing = int(np.count_nonzero(stretch.agrees[chosen]))
        self.agreeing += agreeing
        self.disagreeing += len(byte) - agreeing
        header = stretch.frames.key[: len(stretch.byte)][chosen] >> 8
        answered = self._ids.take(header)
        pairs = np.bincount(answered << 8 | byte, minlength=self._paired.size)
        pairs = pairs.reshape(self._paired.shape)
        self._paired += pairs
        self._answers += pairs.sum(axis=0)
        self._latencies.add(stretch.latency[chosen], answered)
        self._add_kinds("device", kinds, t, header)
        return [int(t[0]), int(t[-1])]

    def _add_kinds(
        self,
        direction: str,
        found: Kinds,
        t: NDArray[np.int64],
        header: NDArray[np.int64] | None,
    ) -> None:
        """Count the anomalies of rows at these times (ns), of or about frames with a header."""
        amounts = np.array([len(kinds) for kinds in found.kinds], np.int64)
        if not amounts.any():
            return
        rows = np.flatnonzero(found.code)  # the first code stands for none
        code = found.code[rows].astype(np.int64)
        self.rates.count("faults", t[rows], amounts[code])
        many = len(self._protocol.ids)
        pairs = code * many
        if header is not None:
            pairs += self._ids.take(header[rows])
        counts = np.bincount(pairs)
        for pair in np.flatnonzero(counts).tolist():
            about = None if header is None else pair % many
            for kind in found.kinds[pair // many]:
                self._faults[direction, about, kind] += int(counts[pair])

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

    def _follow(self, t: NDArray[np.int64], moving: Mask, heard: list[int]) -> None:
        """Add up for how long the car moves; `heard` are times (ns) of bytes that were counted."""
        if not heard:
            self._moving.follow(t, moving)
            return
        first, last = min(heard), max(heard)
        moved = self._moving.follow(t, moving, (min(first, _LATEST), min(last, _LATEST)))
        if self._moved_before is None:
            self._moved_before = moved[0]
        self.moving = max(self.moving, moved[1] - self._moved_before)
        self.first = first if self.first is None else min(self.first, first)
        self.last = last if self.last is None else max(self.last, last)

    # -- records -----------------------------------------------------------------------------------

    def _add_records(self, records: Sequence[Record]) -> list[int]:
        """Count records; returns the times (ns) of their bytes."""
        heard: list[int] = []
        latencies: list[int] = []
        answered: list[int] = []
        for record in records:
            self._add_faults(record)
            if isinstance(record, HostRecord):
                heard += record.t, record.end
                self._add_host(record)
            elif isinstance(record, DeviceRecord):
                heard.append(record.t)
                self.rates.add("device_bytes", record.t)
                self._answers[record.byte] += 1
                self.agreeing += record.agrees is True
                self.disagreeing += record.agrees is False
                if record.latency is not None and record.answered is not None:
                    latencies.append(min(max(record.latency, -_LATEST), _LATEST))
                    answered.append(record.answered.id)
                    self._paired[record.answered.id, record.byte] += 1
        self._latencies.add(latencies, answered)
        return heard

    def _add_host(self, record: HostRecord) -> None:
        self.kinds[record.kind] += 1
        self.host_bytes += len(record.data)
        self.rates.add("host_bytes", record.end, len(record.data))
        if record.judgement:
            self._headers[record.data[0]] += 1
            self._verdicts[OUTCOMES.index(record.judgement.outcome)] += 1
            self.rates.add("frames", record.end)
            self._seconds([(record.end // SECOND, 1)])

    def _add_faults(self, record: Record) -> None:
        faults = serious_faults(record) if record.faults else ()
        direction, identity = _about(record) if faults else ("", None)
        for fault in faults:
            self._faults[direction, identity, fault.kind] += 1
            self.rates.add("faults", fault.t)


def _about(record: Record) -> tuple[str, int | None]:
    """The direction of a record's anomalies, and the ID of the instruction that they are about."""
    if isinstance(record, HostRecord):
        return "host", record.judgement.id if record.judgement else None
    if isinstance(record, DeviceRecord):
        return "device", record.answered.id if record.answered else None
    return (record.value.tap if isinstance(record, LineRecord) else ""), None
