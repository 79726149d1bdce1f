"""Counts by time, in buckets of which there are never too many, however long a recording is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SECOND = 1_000_000_000  # ns
BUCKETS = 1024
"""How many buckets there are at most."""


class Rates:
    """Counts some series in buckets of equal width, which all begin with the first one's second.

    The width is a second; where that makes more than 1,024 buckets, it is twice that, and so on.
    What is earlier than the first count of all is counted in the first bucket.
    """

    def __init__(self, *names: str) -> None:
        self._counts = {name: [0] * BUCKETS for name in names}
        self._used = 0
        self.start = 0
        self.width = SECOND

    def series(self, name: str) -> list[int]:
        """The counts of a series, from the first bucket to the last one that any series has."""
        return self._counts[name][: self._used]

    def count(
        self, name: str, t: NDArray[np.int64], amounts: NDArray[np.integer] | None = None
    ) -> None:
        """Count what came at these times (ns), which never decrease: so much each, or 1."""
        if not len(t):
            return
        self._reach(int(t[0]))
        high = self._reach(int(t[-1]))
        low = self._bucket(int(t[0]))
        if low == high:
            self._counts[name][low] += len(t) if amounts is None else int(amounts.sum())
            return
        edges = self.start + self.width * np.arange(low + 1, high + 1)
        places = [0, *np.searchsorted(t, edges).tolist(), len(t)]
        upto = np.array(places)
        if amounts is not None:
            upto = np.append(0, np.cumsum(amounts))[places]
        for place, amount in enumerate(np.diff(upto).tolist(), low):
            self._counts[name][place] += amount

    def _bucket(self, t: int) -> int:
        return max(0, t - self.start) // self.width

    def _reach(self, t: int) -> int:
        """The bucket of a time, for which the buckets are made wider if they must be."""
        if not self._used:
            self.start = t // SECOND * SECOND
        while (place := self._bucket(t)) >= BUCKETS:
            for name, counts in self._counts.items():
                pairs = map(sum, zip(counts[::2], counts[1::2], strict=True))
                self._counts[name] = [*pairs, *[0] * (BUCKETS // 2)]
            self._used = (self._used + 1) // 2
            self.width *= 2
        self._used = max(self._used, place + 1)
        return place
