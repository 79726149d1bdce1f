"""All rows of a recording as packed batches, and the view of those that pass a filter.

One thread adds batches while others read: what is added is there as a whole or not at all.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from threading import Lock, RLock
from typing import TYPE_CHECKING

import numpy as np

from bilprov.analyzer.decode.batch import Batch, Records
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.screen.packed import PackedBatch
from bilprov.analyzer.screen.row_set import RowSet
from bilprov.analyzer.totals.totals import Totals
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter

TOGETHER = 1024  # rows; smaller batches are packed together
_UNPACKED = 4  # batches that stay unpacked


@dataclass(slots=True)
class _Block:
    """Neighbouring rows that are packed together, None while more may come.

    The first of them has the number `first`, and none of them is older than `t` (ns).
    """

    first: int
    t: int
    packed: PackedBatch | None


class Recording:
    """The rows of a recording, counted from 0 in the order of the records.

    `rows` counts all that came; those before `first` were let go. `faults` are the rows with an
    anomaly, `totals` what was counted so far, let go or not.
    """

    def __init__(self, protocol: Protocol) -> None:
        self.protocol = protocol
        self.rows = 0
        self.first = 0
        self.lock = RLock()
        self.faults = RowSet(self.lock)
        self.totals = Totals(protocol)
        self._blocks: list[_Block] = []
        self._listed: list[Record] = []  # the rows of the last block, where it is not packed yet
        self._unpacked = lru_cache(_UNPACKED)(PackedBatch.batch)

    @property
    def nbytes(self) -> int:
        """The memory that the packed rows take, in bytes."""
        with self.lock:
            return sum(block.packed.nbytes for block in self._blocks if block.packed)

    def add(self, batch: Batch) -> None:
        """Add a batch, which follows those before it."""
        if not len(batch):
            return
        self.totals.add(batch)
        faulty = batch.in_order(batch.serious)
        earliest = np.concatenate([batch.hosts.t, batch.devices.t, batch.others.t]).min()
        packed = PackedBatch(batch) if len(batch) >= TOGETHER else None
        with self.lock:
            if packed or not self._listed:
                self._close_block()
                self._blocks.append(_Block(self.rows, int(earliest), packed))
            if not packed:
                self._listed += batch.records()
            self.faults.append(faulty)
            self.rows += len(batch)
            if len(self._listed) >= TOGETHER:
                self._close_block()

    def _close_block(self) -> None:
        if self._listed:
            self._blocks[-1].packed = PackedBatch(Records(self._listed))
            self._listed = []

    def records(self, rows: Sequence[int]) -> list[Record]:
        """The records of some rows, which increase; none of those that were let go."""
        found: list[Record] = []
        with self.lock:
            there = (row for row in rows if self.first <= row < self.rows)
            for block, some in groupby(there, self._block_of):
                places = [row - block.first for row in some]
                if block.packed is None:
                    found += [self._listed[place] for place in places]
                    continue
                batch = self._unpacked(block.packed)
                chosen = np.zeros(len(batch), np.bool_)
                chosen[places] = True
                found += batch.records(batch.selection(chosen))
        return found

    def batches(self, row: int) -> Iterator[tuple[int, Batch]]:
        """Yield the batches of the rows from `row` on, each with the number of its first row."""
        while row < self.rows:
            with self.lock:
                row = max(row, self.first)
                block = self._block_of(row)
                if block.packed is None:
                    found: tuple[int, Batch] = row, Records(self._listed[row - block.first :])
                else:
                    found = block.first, block.packed.batch()  # not kept: it is seen once
            yield found
            row = found[0] + len(found[1])

    def row_at(self, t: int) -> int:
        """The first row that is not earlier than `t` (ns), but for rows out of order."""
        with self.lock:
            block = max(0, bisect_right(self._blocks, t, key=lambda block: block.t) - 1)
            ends = [block.first for block in self._blocks[block : block + 2]]
            first, stop = (*ends, self.rows, self.rows)[:2]
            rows = range(first, stop)
            return first + bisect_left(rows, t, key=lambda row: self.records([row])[0].t)

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
            self._blocks.pop(0)
            self.first = self._blocks[0].first
            return True

    def _block_of(self, row: int) -> _Block:
        return self._blocks[bisect_right(self._blocks, row, key=lambda block: block.first) - 1]


class View:
    """The rows of a recording that pass a filter, all rows without one (`test` is None).

    Positions count the rows of the view from 0, those that were let go included.
    """

    def __init__(self, recording: Recording, test: Filter | None = None) -> None:
        self.test = test
        self._recording = recording
        self._looking = Lock()
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

    def catch_up(self, cancelled: Callable[[], bool] = lambda: False) -> None:
        """Look at the rows that are new, until all are seen or it is `cancelled`."""
        if self._passing is None or self.test is None:
            return
        passing = self._passing
        with self._looking:
            for first, batch in self._recording.batches(passing.rows):
                if cancelled():
                    return
                passing.append(np.zeros(max(0, first - passing.rows), np.bool_))  # were let go
                passing.append(batch.in_order(self.test.selection(batch))[passing.rows - first :])

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
