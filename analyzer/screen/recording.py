"""All rows of a recording as packed parts, and the view of those that pass a filter.

One thread adds parts while others read: what is added is there as a whole or not at all.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from itertools import groupby
from threading import Event, RLock
from typing import TYPE_CHECKING

import numpy as np
from bilprov.analyzer.columns.decoder import Part, Records

from bilprov.analyzer.columns.totals import Totals
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.screen.packed import Packed, PackedStretch, packed
from bilprov.analyzer.screen.pages import Page, RecordsPage, StretchPage
from bilprov.analyzer.screen.row_set import RowSet
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter

TOGETHER = 4096  # records that are packed together
_PAGES = 4  # that stay unpacked


class _Block:
    """Neighbouring rows that are packed together.

    The first of them has the number `first`, and none of them is older than `t` (ns).
    """

    __slots__ = ("first", "part", "rows", "t")

    def __init__(self, first: int, rows: int, part: Packed, t: int) -> None:
        self.first = first
        self.t = t
        self.rows = rows
        self.part = part


class Recording:
    """The rows of a recording, counted from 0 in the order of the records.

    `rows` counts all that came; those before `first` were let go. `faults` are the rows with an
    anomaly, `totals` what was counted so far, let go or not. `nbytes` is the memory that the packed
    rows take, in bytes.
    """

    def __init__(self, protocol: Protocol) -> None:
        self.protocol = protocol
        self.rows = 0
        self.first = 0
        self.nbytes = 0
        self.lock = RLock()
        self.faults = RowSet(self.lock)
        self.totals = Totals(protocol)
        self._blocks: list[_Block] = []
        self._firsts: list[int] = []
        self._open: _Block | None = None  # of the records `_listed`, which are not packed yet
        self._listed: list[Record] = []
        self._pages: OrderedDict[int, Page] = OrderedDict()

    def add(self, part: Part) -> None:
        """Add a part, which follows those before it."""
        if not part.rows:
            return
        self.totals.add(part)
        if isinstance(part, Records):
            for at in range(0, part.rows, TOGETHER):
                self._add_records(part.listed[at : at + TOGETHER])
            return
        whole = PackedStretch.of(part)
        faulty = StretchPage(part, whole.order).faulty()
        with self.lock:
            self._close_block()
            self.nbytes += whole.nbytes
            self._append(_Block(self.rows, part.rows, whole, part.earliest))
            self.faults.append(faulty)
            self.rows += part.rows

    def _add_records(self, records: list[Record]) -> None:
        faulty = RecordsPage(records).faulty()
        with self.lock:
            if self._open is None:
                self._open = _Block(self.rows, 0, RecordsPage([]), records[0].t)
                self._append(self._open)
            self._listed += records
            self._open.rows += len(records)
            self.faults.append(faulty)
            self.rows += len(records)
            if self._open.rows >= TOGETHER:
                self._close_block()

    def _close_block(self) -> None:
        if self._open is not None:
            self._open.part = packed(Records(self._listed))
            self.nbytes += self._open.part.nbytes
            self._listed = []
            self._open = None

    def _append(self, block: _Block) -> None:
        self._blocks.append(block)
        self._firsts.append(block.first)

    def records(self, rows: Sequence[int]) -> list[Record]:
        """The records of some rows, which increase; none of those that were let go."""
        found: list[Record] = []
        with self.lock:
            there = (row for row in rows if self.first <= row < self.rows)
            for block, some in groupby(there, self._block_of):
                found += self._page(block).records([row - block.first for row in some])
        return found

    def pages(self, row: int) -> Iterator[tuple[Page, int]]:
        """Yield the pages of the rows from `row` on, each with the row's place in it."""
        while row < self.rows:
            with self.lock:
                row = max(row, self.first)
                block = self._block_of(row)
                page, stop = self._page(block), block.first + block.rows
            yield page, row - block.first
            row = stop

    def let_go_older(self, t: int) -> None:
        """Forget the blocks whose records are all older than `t` (ns)."""
        with self.lock:
            while len(self._blocks) > 1 and self._blocks[1].t <= t:
                self.let_go_oldest()

    def let_go_oldest(self) -> bool:
        """Forget the oldest block, and tell whether there was one that is not the last."""
        with self.lock:
            if len(self._blocks) < 2:
                return False
            self.nbytes -= self._blocks[0].part.nbytes
            self._pages.pop(self._blocks[0].first, None)
            del self._blocks[0], self._firsts[0]
            self.first = self._firsts[0]
            return True

    def _block_of(self, row: int) -> _Block:
        return self._blocks[bisect_right(self._firsts, row) - 1]

    def _page(self, block: _Block) -> Page:
        """The unpacked rows of a block; the last ones are kept."""
        if block is self._open:
            return RecordsPage(self._listed[:])
        page = self._pages.pop(block.first, None)
        if page is None:
            page = block.part.page(self.protocol)
        self._pages[block.first] = page
        while len(self._pages) > _PAGES:
            self._pages.popitem(last=False)
        return page


class View:
    """The rows of a recording that pass a filter, all rows without one (`test` is None).

    Positions count the rows of the view from 0, those that were let go included.
    """

    def __init__(self, recording: Recording, test: Filter | None = None) -> None:
        self.test = test
        self._recording = recording
        self._passing = None if test is None else RowSet(recording.lock)

    @property
    def seen(self) -> int:
        """How many rows of the recording were looked at."""
        return self._recording.rows if self._passing is None else self._passing.rows

    @property
    def behind(self) -> int:
        """How many rows of the recording are still to be looked at."""
        return self._recording.rows - self.seen

    @property
    def first(self) -> int:
        """The first position that is still there."""
        return self.position(self._recording.first)

    @property
    def count(self) -> int:
        """How many positions there are."""
        return self._recording.rows if self._passing is None else self._passing.members

    def catch_up(self, cancelled: Event | None = None) -> None:
        """Look at the rows that are new, until all are seen or it is `cancelled`."""
        if self._passing is None or self.test is None:
            return
        passing = self._passing
        gone = self._recording.first - passing.rows
        if gone > 0:
            passing.append(np.zeros(gone, np.bool_))
        for page, place in self._recording.pages(passing.rows):
            if cancelled is not None and cancelled.is_set():
                return
            passing.append(page.passing(self.test, place))

    def rows(self, first: int, stop: int) -> list[int]:
        """The row numbers at the positions from `first` to before `stop`."""
        if self._passing is None:
            return list(range(max(0, first), min(stop, self._recording.rows)))
        return self._passing.slice(max(0, first), stop)

    def position(self, row: int) -> int:
        """The position of a row, or of the next one that passes."""
        return row if self._passing is None else self._passing.before(row)

    def next_fault(self, row: int) -> int | None:
        """The first row after a row that has an anomaly and passes; None if there is none."""
        return self._recording.faults.next(row + 1, self._passing)

    def fault_before(self, row: int) -> int | None:
        """The last row before a row that has an anomaly and passes; None if there is none."""
        found = self._recording.faults.last(row, self._passing)
        return found if found is not None and found >= self._recording.first else None
