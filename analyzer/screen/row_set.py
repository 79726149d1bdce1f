"""A growing set of row numbers as bits, which tells its n-th member and how many are before a row.

A row takes one bit. Rows are only ever added at the end, by one thread; any thread may ask.
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
        self._pages: list[NDArray[np.uint8]] = []  # full ones, eight rows a byte
        self._upto = [0]  # members before each page and the open one
        self._open = np.zeros(PAGE, np.bool_)
        self._filled = 0
        self.members = 0

    @property
    def rows(self) -> int:
        """How many rows are known."""
        return len(self._pages) * PAGE + self._filled

    def append(self, mask: NDArray[np.bool_]) -> None:
        """Add the next rows: whether each of them is a member."""
        at = 0
        while at < len(mask):
            with self._lock:
                part = mask[at : at + PAGE - self._filled]
                self._open[self._filled : self._filled + len(part)] = part
                self._filled += len(part)
                self.members += int(np.count_nonzero(part))
                at += len(part)
                if self._filled == PAGE:
                    self._pages.append(np.packbits(self._open))
                    self._upto.append(self.members)
                    self._open[:] = False
                    self._filled = 0

    def before(self, row: int) -> int:
        """How many members are before a row."""
        with self._lock:
            page = row // PAGE
            if page > len(self._pages):
                return self.members
            return self._upto[page] + int(np.count_nonzero(self._bits(page)[: row % PAGE]))

    def slice(self, first: int, stop: int) -> list[int]:
        """The rows of the members from the `first` to before the `stop`, counted from 0."""
        found: list[int] = []
        with self._lock:
            page = bisect_right(self._upto, first) - 1
            while first < min(stop, self.members):
                members = np.flatnonzero(self._bits(page))
                base = self._upto[page]
                chosen = members[first - base : stop - base] + page * PAGE
                found += chosen.tolist()
                first += len(chosen)
                page += 1
        return found

    def next(self, row: int, among: RowSet | None = None) -> int | None:
        """The first member from a row on, that is a member `among` others too; None without."""
        with self._lock:
            page, low = divmod(row, PAGE)
            while page <= len(self._pages):
                found = np.flatnonzero(self._common(page, among)[low:])
                if len(found):
                    return page * PAGE + low + int(found[0])
                page, low = self._later(page), 0
        return None

    def last(self, row: int, among: RowSet | None = None) -> int | None:
        """The last member before a row, that is a member `among` others too; None without."""
        with self._lock:
            page, high = divmod(min(row, self.rows), PAGE)
            while page >= 0:
                found = np.flatnonzero(self._common(page, among)[:high])
                if len(found):
                    return page * PAGE + int(found[-1])
                page, high = bisect_left(self._upto, self._upto[page]) - 1, PAGE
        return None

    def _later(self, page: int) -> int:
        """The next page with members; behind the last one if there is none."""
        if page == len(self._pages):
            return page + 1
        return bisect_right(self._upto, self._upto[page + 1]) - 1

    def _bits(self, page: int) -> NDArray[np.bool_]:
        if page == len(self._pages):
            return self._open
        return np.unpackbits(self._pages[page]).view(np.bool_)

    def _common(self, page: int, among: RowSet | None) -> NDArray[np.bool_]:
        bits = self._bits(page)
        if among is None:
            return bits
        if page > len(among._pages):
            return np.zeros(PAGE, np.bool_)
        return bits & among._bits(page)
