"""Counts latencies by the microsecond, so that percentiles need no list of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bilprov.captures.schemas import MS
from bilprov.spec.fields import Timing

Place = TypeVar("Place", int, NDArray[np.int64])

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
        nearly = _time(
            touched.start + int(np.searchsorted(upto[1:], upto[-1] * 95 // 100, "right"))
        )
        width = _round_width((nearly - start) // (_BINS - 2))
        first = start // width * width
        edges = [first + width * bin for bin in range(_BINS) if first + width * bin < end]
        stops = [*edges[1:], end if len(edges) == _BINS else edges[-1] + width]
        return [
            Bin(begin, stop, _between(upto, begin - start, stop - start))
            for begin, stop in zip(edges, stops, strict=True)
        ]

    def _touched(self, groups: slice = slice(None)) -> slice:
        """The steps from the first in which there is one to the last."""
        shortest, longest = int(self._shortest[groups].min()), int(self._longest[groups].max())
        if shortest > longest:
            return slice(0, 0)
        return slice(self._place(shortest), self._place(longest) + 1)

    def _place(self, latency: int) -> int:
        """The step of a latency."""
        return min(max((latency + _EARLIEST) // _STEP, 0), len(self._counts) - 1)


def _time(place: Place) -> Place:
    """When (ns) a step begins; of several steps too."""
    return place * _STEP - _EARLIEST


def _round_width(least: int) -> int:
    """A width (ns) of 1, 2 or 5 times a power of ten that is larger than `least`, from 1 us on."""
    width = _STEP
    while True:
        for times in (1, 2, 5):
            if width * times > least:
                return width * times
        width *= 10


def _between(upto: NDArray[np.int64], start: int, stop: int) -> int:
    """How many there are in these ns after the first step, `upto` which step there are how many."""
    low, high = (min(max(at // _STEP, 0), len(upto) - 1) for at in (start, stop))
    return int(upto[high] - upto[low])
