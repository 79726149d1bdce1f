"""Counts latencies by the microsecond, so that percentiles need no list of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bilprov.captures.schemas import MS
from bilprov.spec.fields import Timing

_STEP = 1000  # ns
_EARLIEST = 100 * MS  # ns by which an answer may be stamped before its instruction


_SHARES = (50, 95, 99)  # percent


@dataclass(frozen=True, slots=True)
class Spread:
    """Shortest, median, 95th and 99th percentile, and longest of some latencies, in ns.

    Percentiles are rounded down to 1 us; the ends are exact.
    """

    count: int
    shortest: int
    median: int
    ninety_fifth: int
    ninety_ninth: int
    longest: int


class Latencies:
    """Latencies counted in steps of 1 us, from 100 ms early to the latest that is an answer.

    Those outside count for the nearest step. However many there are, it takes 8 bytes for a us.
    """

    def __init__(self, timing: Timing) -> None:
        latest = round((timing.answer_longest + timing.truncation_longest) * MS)
        self._counts = np.zeros((_EARLIEST + latest) // _STEP + 1, np.int64)
        self._ends: tuple[int, int] | None = None  # the shortest and the longest

    def add(self, latencies: ArrayLike) -> None:
        """Count some more (ns)."""
        found: NDArray[np.int64] = np.asarray(latencies, np.int64)
        if not len(found):
            return
        ends = int(found.min()), int(found.max())
        self._reach(ends)
        last = len(self._counts) - 1
        low, high = (min(max((end + _EARLIEST) // _STEP, 0), last) for end in ends)
        place = ((found + _EARLIEST) // _STEP).clip(0, last) - low
        if high - low <= 16 * len(found) + 1024:
            self._counts[low : high + 1] += np.bincount(place, minlength=high - low + 1)
        else:
            np.add.at(self._counts, place + low, 1)

    def merge(self, other: Latencies) -> None:
        """Count the others' too; they must be of the same timing."""
        self._counts += other._counts
        if other._ends:
            self._reach(other._ends)

    def _reach(self, ends: tuple[int, int]) -> None:
        shortest, longest = self._ends or ends
        self._ends = min(shortest, ends[0]), max(longest, ends[1])

    @property
    def spread(self) -> Spread | None:
        """How they are spread, None if there are none."""
        if self._ends is None:
            return None
        upto = np.cumsum(self._counts)
        count = int(upto[-1])
        places = (int(np.searchsorted(upto, count * share // 100, "right")) for share in _SHARES)
        median, most, nearly = (max(at * _STEP - _EARLIEST, self._ends[0]) for at in places)
        return Spread(count, self._ends[0], median, most, nearly, self._ends[1])
