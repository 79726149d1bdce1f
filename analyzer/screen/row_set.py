"""A growing set of row numbers, which tells its n-th member and how many are before a row.

A row takes one byte. Rows are only ever added at the end, by one thread; any thread may ask.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from threading import RLock

import numpy as np
from numpy.typing import NDArray

PAGE = 1 << 16  # rows of a page


class RowSet:
    """For each row, in order, whether it is one of the `members`, which are so many.

    Sets that are asked about each other share a `lock`.
    """

    def __init__(self, lock: RLock) -> None:
        self._lock = lock
        self._bytes = bytearray()  # grows in place, as no array does
        self._upto = [0]  # members before each page
        self.rows = 0
        self.members = 0

    def append(self, mask: NDArray[np.bool_]) -> None:
        """Add the next rows: whether each of them is a member."""
        with self._lock:
            self._bytes += mask.tobytes()
            self.rows = len(self._bytes)
            while len(self._upto) * PAGE <= self.rows:
                end = len(self._upto) * PAGE
                self._upto.append(self._upto[-1] + self._bytes.count(1, end - PAGE, end))
            self.members = self.before(self.rows)

    def before(self, row: int) -> int:
        """How many members are before a row."""
        with self._lock:
            row = min(row, self.rows)
            page = row // PAGE
            return self._upto[page] + self._bytes.count(1, page * PAGE, row)

    def slice(self, first: int, stop: int) -> list[int]:
        """The rows of the members from the `first` to before the `stop`, counted from 0."""
        with self._lock:
            page = bisect_right(self._upto, first) - 1
            after = bisect_left(self._upto, stop)
            members = np.flatnonzero(self._bits(page * PAGE, after * PAGE)) + page * PAGE
            base = self._upto[page]
            found: list[int] = members[first - base : max(stop, first) - base].tolist()
            return found

    def next(self, row: int, among: RowSet | None = None) -> int | None:
        """The first member from a row on, that is a member `among` others too; None without."""
        with self._lock:
            for at in range(row, self.rows, PAGE):
                found = self._common(at, at + PAGE, among)
                if len(found):
                    return at + int(found[0])
        return None

    def last(self, row: int, among: RowSet | None = None) -> int | None:
        """The last member before a row, that is a member `among` others too; None without."""
        with self._lock:
            for end in range(min(row, self.rows), 0, -PAGE):
                at = max(0, end - PAGE)
                found = self._common(at, end, among)
                if len(found):
                    return at + int(found[-1])
        return None

    def _bits(self, first: int, stop: int) -> NDArray[np.bool_]:
        """Whether some rows are members, as a copy: a view would keep the bytes from growing."""
        return np.frombuffer(self._bytes[first:stop], np.bool_)

    def _common(self, first: int, stop: int, among: RowSet | None) -> NDArray[np.intp]:
        bits = self._bits(first, stop)
        if among is None:
            return np.flatnonzero(bits)
        others = among._bits(first, stop)
        some = min(len(bits), len(others))
        return np.flatnonzero(bits[:some] & others[:some])
