"""Counts over a whole recording, kept up to date batch by batch; memory does not grow with it.

Latencies are counted by the microsecond, so that percentiles need no list of them; counts by time
are kept in buckets, of which there are never too many.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bilprov.analyzer.decode import batch as batches
from bilprov.analyzer.decode.batch import Batch, DeviceRows, HostRows, Mask, Selection
from bilprov.analyzer.decode.records import LineRecord, serious_kinds
from bilprov.captures.schemas import MS
from bilprov.spec.arrays.layouts import OUTCOMES, VALID
from bilprov.spec.fields import Timing
from bilprov.spec.protocol import PLAIN_ANSWER, Protocol

SECOND = 1_000_000_000  # ns
BUCKETS = 1024
"""How many buckets there are at most."""


class Rates:
    """Counts some series in buckets of equal width, which all begin with the first one's second.

    The width is a second; where that makes more than 1,024 buckets, it is twice that, and so on.
    What is earlier than the first count of all is counted in the first bucket.
    """

    def __init__(self, *names: str) -> None:
        self._counts = {name: np.zeros(BUCKETS, np.int64) for name in names}
        self._used = 0
        self.start = 0
        self.width = SECOND

    def series(self, name: str) -> list[int]:
        """The counts of a series, from the first bucket to the last one that any series has."""
        counts: list[int] = self._counts[name][: self._used].tolist()
        return counts

    def count(
        self, name: str, t: NDArray[np.int64], amounts: NDArray[np.integer] | None = None
    ) -> None:
        """Count what came at these times (ns), which never decrease: so much each, or 1."""
        if not len(t):
            return
        self._reach(int(t[0]))
        high, low = self._reach(int(t[-1])), self._bucket(int(t[0]))
        if low == high:
            self._counts[name][low] += len(t) if amounts is None else int(amounts.sum())
            return
        edges = self.start + self.width * np.arange(low + 1, high + 1)
        upto = np.concatenate([[0], np.searchsorted(t, edges), [len(t)]])
        if amounts is not None:
            upto = np.append(0, np.cumsum(amounts))[upto]
        self._counts[name][low : high + 1] += np.diff(upto)

    def _bucket(self, t: int) -> int:
        return max(0, t - self.start) // self.width

    def _reach(self, t: int) -> int:
        """The bucket of a time, for which the buckets are made wider if they must be."""
        if not self._used:
            self.start = t // SECOND * SECOND
        while (place := self._bucket(t)) >= BUCKETS:
            for counts in self._counts.values():
                counts[:] = np.pad(counts.reshape(-1, 2).sum(axis=1), (0, BUCKETS // 2))
            self._used = (self._used + 1) // 2
            self.width *= 2
        self._used = max(self._used, place + 1)
        return place


_STEP = 1000  # ns
_EARLIEST = 100 * MS  # ns by which an answer may be stamped before its instruction
_NEVER = np.iinfo(np.int64)


_SHARES = (50, 95, 99)  # percent
_BINS = 12  # of a histogram


@dataclass(frozen=True, slots=True)
class Spread:
    """Shortest, median, 95th and 99th percentile, and longest of some latencies, in ns.

    A percentile between two latencies is interpolated linearly, so that the median of an even
    number is the mean of the middle two; each is counted as rounded down to 1 us. The ends are
    exact.
    """

    count: int
    min: int
    median: int
    p95: int
    p99: int
    max: int


class Bin(NamedTuple):
    """The `amount` of latencies from `start` up to, not including, `stop` (ns)."""

    start: int
    stop: int
    amount: int


class Latencies:
    """Latencies by group, counted in steps of 1 us.

    They reach from 100 ms early to the latest that is an answer; those outside count for the
    nearest step. However many there are, each group takes 8 bytes for a us near which one is.
    """

    def __init__(self, timing: Timing, groups: int = 1) -> None:
        latest = round((timing.answer_longest + timing.truncation_longest) * MS)
        # By step and group. The system gives it memory only where something is written.
        self._counts = np.zeros(((_EARLIEST + latest) // _STEP + 1, groups), np.int64)
        self._shortest = np.full(groups, _NEVER.max, np.int64)
        self._longest = np.full(groups, _NEVER.min, np.int64)

    def add(self, latencies: ArrayLike, groups: ArrayLike = 0) -> None:
        """Count some more (ns), each in its group or all in one."""
        found: NDArray[np.int64] = np.asarray(latencies, np.int64)
        if not len(found):
            return
        group = np.broadcast_to(np.asarray(groups, np.int64), found.shape)
        shortest, longest = int(found.min()), int(found.max())
        low, high = self._place(shortest), self._place(longest)
        cells = found // _STEP
        cells += _EARLIEST // _STEP
        if shortest < -_EARLIEST or high == len(self._counts) - 1:
            np.clip(cells, 0, len(self._counts) - 1, out=cells)
        cells -= low
        many = self._counts.shape[1]
        cells *= many
        cells += group
        if (high - low + 1) * many <= 16 * len(found) + 1024:
            counts = np.bincount(cells, minlength=(high - low + 1) * many)
            self._counts[low : high + 1] += counts.reshape(-1, many)
        else:
            np.add.at(self._counts[low : high + 1].reshape(-1), cells, 1)
        np.minimum.at(self._shortest, group, found)
        np.maximum.at(self._longest, group, found)

    def merge(self, other: Latencies) -> None:
        """Count the others' too; they must be of the same timing and have the same groups."""
        touched = other._touched()
        self._counts[touched] += other._counts[touched]
        np.minimum(self._shortest, other._shortest, out=self._shortest)
        np.maximum(self._longest, other._longest, out=self._longest)

    def spread(self, group: int | None = None) -> Spread | None:
        """How they are spread, in a group or in all of them; None if there are none."""
        chosen = slice(None) if group is None else slice(group, group + 1)
        touched = self._touched(chosen)
        if touched.start == touched.stop:
            return None
        shortest, longest = int(self._shortest[chosen].min()), int(self._longest[chosen].max())
        upto = np.cumsum(self._counts[touched, chosen].sum(axis=1))
        count = int(upto[-1])
        ranks = np.array(_SHARES) / 100 * (count - 1)
        below, above = (
            np.maximum(_time(touched.start + np.searchsorted(upto, rank, "right")), shortest)
            for rank in (np.floor(ranks), np.ceil(ranks))
        )
        median, most, nearly = np.rint(below + (above - below) * (ranks % 1)).astype(int).tolist()
        return Spread(count, shortest, median, most, nearly, longest)

    def histogram(self) -> list[Bin]:
        """All of them in at most 12 bins; the last has all that is left.

        The others have the same width, a round one such that 95 of 100 latencies fall into them.
        """
        touched = self._touched()
        if touched.start == touched.stop:
            return []
        upto = np.append(0, np.cumsum(self._counts[touched].sum(axis=1)))
        start, end = _time(touched.start), _time(touched.stop)
        nearly = touched.start + int(np.searchsorted(upto[1:], upto[-1] * 95 // 100, "right"))
        least = (_time(nearly) - start) // (_BINS - 2)
        widths = (times * 10**power for power in range(3, 19) for times in (1, 2, 5))
        width = next(width for width in widths if width > least)
        first = start // width * width
        edges = [first + width * bin for bin in range(_BINS) if first + width * bin < end]
        stops = [*edges[1:], end if len(edges) == _BINS else edges[-1] + width]
        steps = (np.array([edges, stops]) - start) // _STEP
        below, upto_stop = upto.take(steps, mode="clip")
        return [*map(Bin, edges, stops, (upto_stop - below).tolist())]

    def _touched(self, groups: slice = slice(None)) -> slice:
        """The steps from the first in which there is one to the last."""
        shortest, longest = int(self._shortest[groups].min()), int(self._longest[groups].max())
        if shortest > longest:
            return slice(0, 0)
        return slice(self._place(shortest), self._place(longest) + 1)

    def _place(self, latency: int) -> int:
        """The step of a latency."""
        return min(max((latency + _EARLIEST) // _STEP, 0), len(self._counts) - 1)


def _time(place: Any) -> Any:
    """When (ns) a step begins; of several steps too."""
    return place * _STEP - _EARLIEST


DAMAGED = "damaged"
"""Stands for the name of an answer that has none, since it is damaged."""

SERIES = ("frames", "faults", "host_bytes", "device_bytes")
"""What is counted by time, each frame when it ended."""


_COUNTS = ("_headers", "_due", "_answers", "_paired", "_faults", "kinds")
_SUMS = ("host_bytes", "device_bytes", "agreeing", "disagreeing", "moving")
_UNCODED = len(OUTCOMES)  # stands for a valid frame whose answer has no code


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
    """Counts the batches of a recording.

    `kinds` counts host records (`instruction`, `truncated`, `garbage`), `host_bytes` and
    `device_bytes` their bytes. `first` and `last` are the times (ns) of the first and the last
    byte, None without any; in between the wheels turn for `moving` (ns), as is predicted.
    `latencies` are those of the answers, by ID of the instruction.
    `agreeing` and `disagreeing` count answers that are the expected one or not; for others nothing
    is expected. `peak` is the largest number of frames that ended in one second of the recording's
    clock, `rates` has `SERIES` by time. Anomalies are counted without those of severity info.
    """

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        # By key of a frame: its ID, and the group of its latencies. Unused IDs share one where they
        # are many.
        self._ids = np.array(protocol.keys, np.int64)
        apart = protocol.ids if protocol.plain else sorted(protocol.by_id)
        places = {identity: place for place, identity in enumerate(dict.fromkeys(apart))}
        groups = [places.get(identity, len(places)) for identity in protocol.keys]
        self._groups = np.array(groups, np.int64)
        self._headers = np.zeros(256, np.int64)
        self._due = np.zeros(_UNCODED + 1, np.int64)  # of these, the ones to be answered
        self._uncoded = np.isin(np.arange(256), list(protocol.uncoded))
        self._answers: Counter[str] = Counter()
        self._paired: Counter[tuple[int, str]] = Counter()  # by ID and name of the answer
        self.latencies = Latencies(protocol.timing, len(places) + 1)
        self._faults: Counter[tuple[str, int | None, str]] = Counter()  # direction, ID, kind
        self._turning = protocol.power_on.moving
        self._turned = 0  # ns, up to the last change, at `_since`
        self._since: int | None = None
        self._turned_before: int | None = None  # ns, at `first`
        self._second, self._in_second = -1, 0
        self.rates = Rates(*SERIES)
        self.kinds: Counter[str] = Counter()
        self.host_bytes = 0
        self.device_bytes = 0
        self.agreeing = 0
        self.disagreeing = 0
        self.first: int | None = None
        self.last: int | None = None
        self.moving = 0
        self.peak = 0

    def add(self, batch: Batch, chosen: Selection | None = None) -> None:
        """Count the chosen rows (None: all) of a batch, which follows those before it."""
        host, device, other = chosen or (None, None, None)
        for place, record in enumerate(batch.others.listed):
            side = record.value.tap if isinstance(record, LineRecord) else ""
            for kind in serious_kinds(record) if other is None or other[place] else ():
                self._faults[side, None, kind] += 1
                self.rates.count("faults", batch.others.t[place : place + 1])
        heard = self._add_hosts(batch.hosts, host) + self._add_devices(batch.devices, device)
        self._follow(batch.hosts, heard)

    def merge(self, other: Totals) -> None:
        """Count another recording, of the same protocol; times and rates have no meaning then."""
        for name in (*_COUNTS, *_SUMS):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.latencies.merge(other.latencies)
        self.peak = max(self.peak, other.peak)

    @property
    def frames(self) -> int:
        """How many host frames there are, whole and truncated ones."""
        return int(self._headers.sum())

    @property
    def answers(self) -> int:
        """How many answers the device has given, whatever their length."""
        return self._answers.total()

    def faults_of(self, direction: str | None = None, identity: int | None = None) -> Counter[str]:
        """Anomalies by kind of one direction (`host`, `device`, "" for neither), one ID, or all."""
        counts: Counter[str] = Counter()
        for (side, about, kind), count in self._faults.items():
            if direction in (None, side) and identity in (None, about):
                counts[kind] += count
        return counts

    def instructions(self) -> dict[str, Instruction]:
        """The counts of each instruction of the grammar, and of each unused ID that occurs."""
        named = {spec.id: spec.name for spec in self._protocol.instructions}
        for identity in np.unique(self._ids[self._headers > 0]).tolist():
            named.setdefault(identity, f"unused {identity}" if identity >= 0 else "unreadable")
        return {name: self._instruction(identity) for identity, name in named.items()}

    def expected(self) -> dict[str, int]:
        """How often each response is the one that a conforming device gives."""
        found: dict[str, int] = {}
        specs = [self._protocol.answers[outcome] for outcome in OUTCOMES]
        for spec, count in zip([*specs, PLAIN_ANSWER], self._due.tolist(), strict=True):
            if spec.outcomes and (count or spec in specs):
                found[spec.name] = found.get(spec.name, 0) + count
        return found

    def responses(self) -> dict[str, int]:
        """How often the device has given each response, and each unused code."""
        return {**dict.fromkeys(self._names, 0), **self._by_name(self._answers)}

    @cached_property
    def _names(self) -> list[str]:
        """The names of the responses, that of answers without a code in front."""
        named = [spec.name for spec in self._protocol.responses]
        coded = self._protocol.reply.part("code") is not None
        return named if coded else [PLAIN_ANSWER.name, *named]

    def _by_name(self, counts: Mapping[str, int]) -> dict[str, int]:
        """Some counts, those of the grammar's responses first."""
        used = [name for name in self._names if name in counts]
        width = 10 if self._protocol.plain else 0  # unused codes are ordered by their numbers
        others = sorted(counts.keys() - {*self._names}, key=lambda name: name.rjust(width))
        return {name: counts[name] for name in (*used, *others)}

    def _instruction(self, identity: int) -> Instruction:
        group = self._groups[self._ids == identity]
        # Of several unused IDs it is not known which latency belongs to which.
        known = len(group) and np.count_nonzero(self._headers[self._groups == group[0]]) <= 1
        paired = {name: count for (one, name), count in self._paired.items() if one == identity}
        return Instruction(
            frames=int(self._headers[self._ids == identity].sum()),
            responses=self._by_name(paired),
            faults=dict(self.faults_of(identity=identity).most_common()),
            latencies=self.latencies.spread(int(group[0])) if known else None,
        )

    def _add_hosts(self, hosts: HostRows, mask: Mask | None) -> list[int]:
        """Count rows of the host; returns the times (ns) of the first and the last byte."""
        rows = slice(None) if mask is None else mask
        end, size = hosts.end[rows], hosts.size[rows]
        verdict, kind = hosts.verdict[rows], hosts.kind[rows]
        if not len(end):
            return []
        header = hosts.header[rows]
        self.kinds += Counter(dict(zip(batches.KINDS, np.bincount(kind).tolist(), strict=False)))
        self.host_bytes += int(size.sum())
        self.rates.count("host_bytes", end, size)
        self._add_kinds("host", hosts.faults.of(mask), hosts.known[rows], header)
        start, last = int(hosts.t[rows].min()), int(end.max())
        if self.kinds["garbage"]:
            frames = verdict != batches.NO_VERDICT
            header, verdict, end = header[frames], verdict[frames], end[frames]
        self._headers += np.bincount(header, minlength=256)
        if hosts.due is not None:
            due = hosts.due[rows]
            header, verdict = hosts.header[rows][due], hosts.verdict[rows][due]
        uncoded = self._uncoded.take(header) & (verdict == VALID)
        verdict = np.where(uncoded, np.uint8(_UNCODED), verdict)
        self._due += [np.count_nonzero(verdict == place) for place in range(_UNCODED + 1)]
        self.rates.count("frames", end)
        self._ended(end)
        return [start, last]

    def _add_devices(self, devices: DeviceRows, mask: Mask | None) -> list[int]:
        """Count rows of the device; returns the times (ns) of the first and the last."""
        rows = slice(None) if mask is None else mask
        t, agrees = devices.t[rows], devices.agrees[rows]
        if not len(t):
            return []
        size = devices.size[rows]
        self.device_bytes += int(size.sum())
        self.rates.count("device_bytes", t, size)
        self.agreeing += int(np.count_nonzero(agrees == 1))
        self.disagreeing += int(np.count_nonzero(agrees == 0))
        name = devices.name[rows]
        names = [
            name or (f"unused {place}" if self._protocol.plain else DAMAGED)
            for place, name in enumerate(devices.names)
        ]
        given = np.bincount(name)
        for place in np.flatnonzero(given).tolist():
            self._answers[names[place]] += int(given[place])
        answering = devices.answering[rows]
        header, latency = devices.header[rows], devices.latency[rows]
        self._add_kinds("device", devices.faults.of(mask), t, header, answering)
        if not answering.all():
            header, name, latency = header[answering], name[answering], latency[answering]
        counts = np.bincount(header.astype(np.int64) * len(names) + name)
        for pair in np.flatnonzero(counts).tolist():
            key, place = divmod(pair, len(names))
            self._paired[int(self._ids[key]), names[place]] += int(counts[pair])
        self.latencies.add(latency, self._groups.take(header))
        return [int(t.min()), int(t.max())]

    def _add_kinds(
        self,
        direction: str,
        found: batches.Kinds,
        t: NDArray[np.int64],
        header: NDArray[np.uint8],
        about: Mask | None = None,
    ) -> None:
        """Count the anomalies of rows at these times (ns).

        They are of or about frames with a header, or where `about` is false about none.
        """
        amounts = found.amounts
        rows = np.flatnonzero(found.code)  # the first code stands for none
        if not len(rows) or not amounts.any():
            return
        code = found.code[rows].astype(np.int64)
        self.rates.count("faults", t[rows], amounts[code])
        many = len(self._ids) + 1  # the last stands for no instruction
        key = header[rows].astype(np.int64)
        if about is not None:
            key = np.where(about[rows], key, many - 1)
        counts = np.bincount(code * many + key)
        for pair in np.flatnonzero(counts).tolist():
            place = pair % many
            for kind in found.kinds[pair // many]:
                nobody = place == many - 1 or kind == "garbage"
                identity = None if nobody else int(self._ids[place])
                self._faults[direction, identity, kind] += int(counts[pair])

    def _ended(self, end: NDArray[np.int64]) -> None:
        """Count frames that ended at these times, which increase."""
        seconds, counts = np.unique(end // SECOND, return_counts=True)
        for second, count in zip(seconds.tolist(), counts.tolist(), strict=True):
            if second != self._second:
                self._second, self._in_second = second, 0
            self._in_second += count
            self.peak = max(self.peak, self._in_second)

    def _follow(self, hosts: HostRows, heard: list[int]) -> None:
        """Add up for how long the wheels turn; `heard` are times (ns) of bytes that were counted.

        Those are not before the changes that came with an earlier batch.
        """
        t = hosts.known
        begin = min([*heard, *t[:1].tolist()], default=0) if self._since is None else self._since
        turns = np.append(self._turning, hosts.states.moving)
        changes = np.flatnonzero(turns[1:] != turns[:-1])
        at = np.maximum.accumulate(np.append(begin, t[changes]))
        turns = turns[np.append(0, 1 + changes)]
        total = self._turned + np.append(0, np.cumsum(np.diff(at) * turns[:-1]))
        self._turned, self._since, self._turning = int(total[-1]), int(at[-1]), bool(turns[-1])
        if not heard:
            return
        asked = np.array([min(heard), max(heard)])
        place = np.searchsorted(at, asked, "right").clip(1) - 1
        before, upto = (total[place] + (asked - at[place]).clip(0) * turns[place]).tolist()
        if self._turned_before is None:
            self._turned_before = before
        self.moving = max(self.moving, upto - self._turned_before)
        first, last = asked.tolist()
        self.first = first if self.first is None else min(self.first, first)
        self.last = last if self.last is None else max(self.last, last)
