"""All rows of a recording as packed batches, and the view of those that pass a filter.

A batch is packed to about a tenth of the size of its records.

One thread adds batches while others read: what is added is there as a whole or not at all.
"""

from __future__ import annotations

import math
import os
import pickle  # of our own bytes alone
import time
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from itertools import groupby
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
import zstandard
from numpy.typing import NDArray

from bilprov.analyzer.decode.batch import Batch, Records
from bilprov.analyzer.decode.columns import ColumnDecoder
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.files import whole_file, why_not_writable
from bilprov.analyzer.output.outputs import opened_output
from bilprov.analyzer.output.row_columns import RowStyle
from bilprov.analyzer.totals.totals import Totals
from bilprov.captures.text import printable
from bilprov.spec.protocol import InstructionSpec, Protocol, ResponseSpec

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter

_LEVEL = 1  # of zstd
_KINDS = [np.iinfo(kind) for kind in ("u1", "i1", "u2", "i2", "u4", "i4", "i8")]
_UNPACKED = 4  # batches that stay unpacked
_SHARED = (ColumnDecoder, InstructionSpec, ResponseSpec)
_KEPT: dict[int, object] = {}  # what packed batches share, of which there are a few for a grammar


def packed(batch: Batch) -> bytes:
    """A batch as compressed bytes; what it rests on, its grammar and tables, is left out."""
    file = BytesIO()
    pickler = pickle.Pickler(file, pickle.HIGHEST_PROTOCOL)
    # A persistent id is asked for each object: packing records would be twice as slow.
    pickler.dispatch_table = {np.ndarray: _as_steps, **dict.fromkeys(_SHARED, _share)}
    pickler.dump(batch)
    return zstandard.ZstdCompressor(_LEVEL).compress(file.getbuffer())


def _unpacked(data: bytes) -> Batch:
    """The batch of packed bytes."""
    batch: Batch = pickle.loads(zstandard.ZstdDecompressor().decompress(data))
    return batch


_looked_at = lru_cache(_UNPACKED)(_unpacked)
"""The same, of batches that are on the screen: the last ones stay unpacked."""


def _share(value: object) -> tuple[Any, ...]:
    """Keep a value beside the packed bytes, which have only its number."""
    _KEPT[id(value)] = value
    return _kept, (id(value),)


def _kept(number: int) -> object:
    return _KEPT[number]


def _as_steps(array: NDArray[Any]) -> Any:
    """How an array is packed: 64-bit integers as steps, or as they are, in as few bytes as fit."""
    if array.dtype != np.int64 or array.ndim != 1:
        return array.__reduce_ex__(pickle.HIGHEST_PROTOCOL)
    values, steps = _small(array), _small(np.diff(array))
    if len(steps) and (steps == steps[0]).all():
        step = int(steps[0])
        return _evenly, (int(array[0]), step, len(array))
    if values.itemsize <= steps.itemsize:
        return np.array, (values, np.int64)
    return _summed, (int(array[0]), steps)


def _evenly(first: int, step: int, count: int) -> NDArray[np.int64]:
    """That many integers with the same step between them."""
    return first + step * np.arange(count)


def _small(numbers: NDArray[np.int64]) -> NDArray[np.integer]:
    """The numbers in the smallest type that holds all of them."""
    low, high = numbers.min(initial=0), numbers.max(initial=0)
    return numbers.astype(next(one.dtype for one in _KINDS if one.min <= low <= high <= one.max))


def _summed(first: int, steps: NDArray[np.integer]) -> NDArray[np.int64]:
    """The integers with these steps between them."""
    return np.concatenate([[first], steps], dtype=np.int64).cumsum()


PAGE = 1 << 16  # members that are compared at once


class RowSet:
    """A growing set of row numbers, which tells its n-th member and how many are before a row.

    A member takes four bytes. Rows are only ever added at the end, by one thread; any thread may
    ask. `rows` of them were added. Sets that are asked about each other share a `lock`.
    """

    def __init__(self, lock: RLock) -> None:
        self._lock = lock
        self._members = array("I")  # grows in place, as no array of numpy does
        self.rows = 0

    def append(self, mask: NDArray[np.bool_]) -> None:
        """Add the next rows: whether each of them is a member."""
        with self._lock:
            self._members.frombytes((np.flatnonzero(mask) + self.rows).astype(np.uint32).tobytes())
            self.rows += len(mask)

    @property
    def members(self) -> int:
        """How many members there are."""
        return len(self._members)

    def before(self, row: int) -> int:
        """How many members are before a row."""
        with self._lock:
            return bisect_left(self._members, row)

    def slice(self, first: int, stop: int) -> list[int]:
        """The rows of the members from the `first` to before the `stop`, counted from 0."""
        with self._lock:
            return self._members[first:stop].tolist()

    def next(self, row: int, among: RowSet | None = None) -> int | None:
        """The first member from a row on, that is a member `among` others too; None without."""
        with self._lock:
            for at in range(self.before(row), self.members, PAGE):
                found = self._common(at, at + PAGE, among)
                if len(found):
                    return int(found[0])
        return None

    def last(self, row: int, among: RowSet | None = None) -> int | None:
        """The last member before a row, that is a member `among` others too; None without."""
        with self._lock:
            for end in range(self.before(row), 0, -PAGE):
                found = self._common(max(0, end - PAGE), end, among)
                if len(found):
                    return int(found[-1])
        return None

    def _common(self, first: int, stop: int, among: RowSet | None) -> NDArray[np.uint32]:
        """The members from the `first` to before the `stop` that are members `among` others too."""
        members = np.frombuffer(self._members[first:stop], np.uint32)
        if among is None:
            return members
        others = among._members[among.before(members[0]) : among.before(members[-1] + 1)]
        return np.intersect1d(members, np.frombuffer(others, np.uint32), assume_unique=True)


TOGETHER = 1024  # rows; smaller batches are packed together


@dataclass(slots=True)
class _Block:
    """Neighbouring rows that are packed together, None while more may come.

    The first of them has the number `first`, and none of them is older than `t` (ns).
    """

    first: int
    t: int
    packed: bytes | None


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

    @property
    def nbytes(self) -> int:
        """The memory that the packed rows take, in bytes."""
        with self.lock:
            return sum(len(block.packed or b"") for block in self._blocks)

    def add(self, batch: Batch) -> None:
        """Add a batch, which follows those before it."""
        if not len(batch):
            return
        self.totals.add(batch)
        faulty = batch.in_order(batch.serious)
        earliest = np.concatenate([batch.hosts.t, batch.devices.t, batch.others.t]).min()
        whole = packed(batch) if len(batch) >= TOGETHER else None
        with self.lock:
            if whole or not self._listed:
                self._close_block()
                self._blocks.append(_Block(self.rows, int(earliest), whole))
            if not whole:
                self._listed += batch.records()
            self.faults.append(faulty)
            self.rows += len(batch)
            if len(self._listed) >= TOGETHER:
                self._close_block()

    def _close_block(self) -> None:
        if self._listed:
            self._blocks[-1].packed = packed(Records(self._listed))
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
                batch = _looked_at(block.packed)
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
                first = block.first if block.packed else row
                rest = self._listed[row - block.first :]
                batch = _unpacked(block.packed) if block.packed else Records(rest)
            yield first, batch
            row = first + len(batch)

    def row_at(self, t: int) -> int:
        """The first row that is not earlier than `t` (ns), but for rows out of order."""
        with self.lock:
            block = max(0, bisect_right(self._blocks, t, key=lambda block: block.t) - 1)
            ends = [block.first for block in self._blocks[block : block + 2]]
            first, stop = (*ends, self.rows, self.rows)[:2]
            return bisect_left(range(stop), t, first, key=lambda row: self.records([row])[0].t)

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
        self._passing = None if test is None else RowSet(recording.lock)

    @property
    def seen(self) -> int:
        """How many rows of the recording were looked at."""
        return self._recording.rows if self._passing is None else self._passing.rows

    @property
    def first(self) -> int:
        """The first position that is still there."""
        return self.position(self._recording.first)

    @property
    def count(self) -> int:
        """How many positions there are."""
        return self._recording.rows if self._passing is None else self._passing.members

    def catch_up(self, most: float = math.inf) -> bool:
        """Look at the rows that are new, for about `most` s; returns whether all are seen."""
        passing, end = self._passing, time.monotonic() + most
        if passing is not None and self.test is not None:
            for first, batch in self._recording.batches(passing.rows):
                passing.append(np.zeros(max(0, first - passing.rows), np.bool_))  # were let go
                passing.append(batch.in_order(self.test.selection(batch))[passing.rows - first :])
                if time.monotonic() > end:
                    break
        return self.seen >= self._recording.rows

    def rows(self, first: int, stop: int) -> list[int]:
        """The row numbers at the positions from `first` to before `stop`."""
        if self._passing is None:
            return list(range(max(0, first), min(stop, self._recording.rows)))
        return self._passing.slice(max(0, first), stop)

    def position(self, row: int) -> int:
        """The position of a row, or of the next one that passes."""
        return row if self._passing is None else self._passing.before(row)

    def fault(self, row: int, step: int) -> int | None:
        """The next row with an anomaly that passes; with step -1 the one before; None without."""
        faults = self._recording.faults
        if step > 0:
            return faults.next(row + 1, self._passing)
        found = faults.last(row, self._passing)
        return found if found is not None and found >= self._recording.first else None


_TOGETHER = 4096  # rows


def rows_file(name: str) -> str:
    """The name of a new file for rows. Raises ValueError if they cannot be written there."""
    if Path(name).suffix not in (".csv", ".jsonl"):
        raise ValueError("the name ends in .csv or .jsonl, which sets the format")
    return new_file(name)


def new_file(name: str) -> str:
    """The name of a new file. Raises ValueError if none can have it."""
    if os.path.lexists(name):
        raise ValueError(f"{printable(name)} exists and is never overwritten: choose another name")
    try:
        why = why_not_writable(Path(name))
    except (OSError, ValueError) as error:
        why = f"no file can have this name: {printable(error)}"
    if why:
        raise ValueError(why)
    return name


def export(
    recording: Recording, view: View, name: str, rows: RowStyle, start_wall: int
) -> Iterator[int]:
    """Write the rows that a view has now, and yield again and again how many are written.

    Unless it comes to its end, no file is left. Raises OSError, or ValueError, if there is one, or
    none can be written.
    """
    first, count, written = view.first, view.count, 0
    style = cast(Literal["csv", "jsonl"], Path(name).suffix[1:])

    def write(text: str) -> None:
        nonlocal written
        file.write(text.encode("utf-8", "backslashreplace"))
        written += text.count("\n")  # events of the line are rows only on the screen

    with whole_file(Path(name), replace=False) as file:
        output = opened_output(style, recording.protocol, rows, start_wall, write)
        written = 0
        for at in range(first, count, _TOGETHER):
            output.records(recording.records(view.rows(at, min(at + _TOGETHER, count))))
            yield written
    yield written
