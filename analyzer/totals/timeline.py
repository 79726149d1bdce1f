"""What happens in a recording along its time, for a picture: states, latencies and anomalies.

Each of the three has at most so many rows, however long the recording is. Up to then they are
exact; after that a row holds what was in one step of time, whose width doubles as often as need be.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.decode.batch import Batch, Selection
from bilprov.analyzer.decode.records import serious_faults
from bilprov.spec.protocol import Protocol

MOST = 1 << 14
"""Rows of states, and of latencies, at most."""

MOST_MARKS = 1000
"""Marks of anomalies at most."""

SHORTEST_IDLE = 10_000_000_000
"""Ns without traffic that count as idle at the least."""

MOST_IDLE = 20
"""Idle times at most: the longest."""

_FINEST = 1000  # ns of the narrowest step

Places: TypeAlias = NDArray[np.int64]
Table: TypeAlias = NDArray[np.int64]
"""Rows by columns, the first of which is the time (ns)."""


class Mark(NamedTuple):
    """Anomalies: the first one's time (ns), how many are in its step, its kind and reason."""

    t: int
    amount: int
    kind: str
    reason: str


class Timeline:
    """Takes the batches of a recording in order, and gives `states`, `latencies` and `marks`.

    `begin` and `end` are the times (ns) of the first and the last byte or anomaly; those of
    severity info are left out.
    """

    def __init__(self, protocol: Protocol) -> None:
        self._word = word_of(protocol)
        self._numbers = numbers_of(protocol)
        self._last = (-1, *(0 for _ in self._numbers))  # no state is like that
        at_first = protocol.power_on
        self._power_on = (
            2 * (at_first.code(self._word, getattr(at_first, self._word)) if self._word else 0)
            + at_first.moving,
            *(at_first.code(name, getattr(at_first, name)) for name in self._numbers),
        )
        # A step may take two rows: one for what changes in it, one for what holds after it.
        self._states = _Rows(_merged_states, 3 + 3 * len(self._numbers), MOST, MOST // 2)
        self._latencies = _Rows(_merged_latencies, 4, MOST, MOST // 2)
        self._marks = _Rows(_merged_marks, 3, MOST_MARKS, MOST_MARKS)
        self._said: dict[int, tuple[str, str]] = {}  # kind and reason, by the mark's number
        self._numbered = 0  # marks so far
        self._end: int | None = None
        self._idle: list[tuple[int, int]] = []
        self.begin = 0

    @property
    def end(self) -> int:
        """The time (ns) of the last byte or anomaly."""
        return self.begin if self._end is None else self._end

    def add(self, batch: Batch) -> None:
        """Take the next batch."""
        hosts, devices, serious = batch.hosts, batch.devices, batch.serious
        odd = batch.others.t[serious.other]
        self._reach(np.concatenate([hosts.t, hosts.end, devices.t, odd]))
        states = hosts.states
        code = states.moving.astype(np.int64)
        if self._word is not None:
            code += 2 * states[self._word].astype(np.int64)
        self._add_states(hosts.known, code, *(states[name] for name in self._numbers))
        answering = devices.answering
        t, latency = devices.t[answering], devices.latency[answering]
        self._latencies.add(np.column_stack([t, latency, latency, np.ones(len(t), np.int64)]))
        self._add_marks(batch, serious)

    def states(self) -> tuple[dict[str, Any], int]:
        """The states from `begin` on as lists, and the width (ns) of the steps, 0 for exact rows.

        Each row holds from its time `t` (ns) to the next one's. `motion` is the place of a word,
        twice, plus 1 while the device moves; `seen` has a bit for each such value that occurs in
        the row. Each variable that is a number has its value at the end (`last`) of each row, and
        the lowest and the highest inside (`low`, `high`).
        """
        table, step = self._states.reduced()
        table[:1, 0] = self.begin  # the state at power-on
        if step:
            table = np.concatenate([table, _held_after(table[-1:], step)])
        t, motion, seen, *ranges = (column.tolist() for column in table.T)
        named = {
            name: dict(zip(("last", "low", "high"), ranges[3 * at :], strict=False))
            for at, name in enumerate(self._numbers)
        }
        return {"t": t, "motion": motion, "seen": seen, **named}, step

    def latencies(self) -> tuple[dict[str, list[int]], int]:
        """When (`t`, ns) answers came, and the lowest and highest of `count` latencies (ns) each.

        And the width (ns) of the steps, 0 where each row is one answer.
        """
        table, step = self._latencies.reduced()
        columns = (column.tolist() for column in table.T)
        return dict(zip(("t", "low", "high", "count"), columns, strict=True)), step

    def marks(self) -> tuple[list[Mark], int]:
        """The anomalies in order, and the width (ns) of the steps; 0 where each has its mark."""
        table, step = self._marks.reduced()
        return [Mark(t, amount, *self._said[one]) for t, amount, one in table.tolist()], step

    def idle(self) -> list[tuple[int, int]]:
        """The longest times without a byte or an anomaly, in order: from when to when (ns)."""
        return sorted(self._idle)

    def _reach(self, times: NDArray[np.int64]) -> None:
        """Take in bytes and anomalies at these times (ns)."""
        if not len(times):
            return
        first = int(times.min())
        if self._end is None:
            self._add_states(*(np.array([value], np.int64) for value in (first, *self._power_on)))
        if self._end is None or first < self.begin:  # a frame may have begun before what is known
            self.begin = first
            for rows in (self._states, self._latencies, self._marks):
                rows.begin = first
        before, self._end = self.end, max(self.end, int(times.max()))
        if self._end - before >= SHORTEST_IDLE:
            times = np.sort(np.append(before, times[times > before]))
            long = np.flatnonzero(np.diff(times) >= SHORTEST_IDLE)
            self._idle += zip(times[long].tolist(), times[long + 1].tolist(), strict=True)
            self._idle.sort(key=lambda idle: idle[0] - idle[1])
            del self._idle[MOST_IDLE:]

    def _add_states(self, t: NDArray[np.int64], *values: NDArray[np.signedinteger]) -> None:
        """Take states in order, each with the time (ns) from which on it holds."""
        changed = np.zeros(len(t), np.bool_)
        for column, last in zip(values, self._last, strict=True):
            changed |= np.append(last, column[:-1]) != column
        rows = np.flatnonzero(changed)
        if len(rows):
            self._last = tuple(int(column[-1]) for column in values)
            motion, *numbers = (column.take(rows) for column in values)
            columns = [t.take(rows), motion, 1 << motion.astype(np.int64)]
            columns += [column for column in numbers for _ in range(3)]
            self._states.add(np.column_stack(columns))

    def _add_marks(self, batch: Batch, serious: Selection) -> None:
        found = [np.flatnonzero(mask) for mask in serious]
        if not any(map(len, found)):
            return
        sides = (batch.hosts.known, batch.devices.t, batch.others.t)
        t = np.concatenate([times[rows] for times, rows in zip(sides, found, strict=True)])
        kinds = zip((batch.hosts.faults, batch.devices.faults), found, strict=False)
        amounts = [one.amounts.take(one.code[rows]) for one, rows in kinds]
        amount = np.concatenate([*amounts, np.ones(len(found[2]), np.int64)])
        first, self._numbered = self._numbered, self._numbered + len(t)
        self._marks.add(np.column_stack([t, amount, np.arange(first, self._numbered)]))
        table, _ = self._marks.reduced()
        self._said = {one: self._said[one] for one in table[:, 2].tolist() if one < first}
        # Records are made of those marks alone that are kept.
        kept = np.zeros(len(t), np.bool_)
        kept[table[table[:, 2] >= first, 2] - first] = True
        for side, rows in enumerate(np.split(kept, np.cumsum([len(one) for one in found])[:-1])):
            chosen = [np.zeros(len(one), np.bool_) for one in sides]
            chosen[side][found[side][rows]] = True
            numbers = (first + np.flatnonzero(rows)).tolist()
            for number, record in zip(numbers, batch.records(Selection(*chosen)), strict=True):
                faults = serious_faults(record)
                named = ", ".join(fault.kind for fault in faults)
                self._said[number] = named, "; ".join(fault.reason for fault in faults)
            first += len(rows)


Merge: TypeAlias = Callable[[Table, Places, Places, int], Table]


class _Rows:
    """A table of at most `most` rows; when there are more, `merge` puts rows together.

    It gets the table, the first row of each step of time, when (ns) that begins, and its width.
    Then there are so many `steps` at most.
    """

    def __init__(self, merge: Merge, width: int, most: int, steps: int) -> None:
        self._merge = merge
        self._most, self._steps = most, steps
        self._pieces = [np.zeros((0, width), np.int64)]
        self._count = 0
        self._step = 0
        self.begin = 0

    def add(self, table: Table) -> None:
        """Take more rows."""
        self._pieces.append(table)
        self._count += len(table)
        if self._count > 4 * self._most:
            self.reduced()

    def reduced(self) -> tuple[Table, int]:
        """All of the rows, and the width (ns) of the steps, 0 if the rows are exact."""
        table = np.concatenate(self._pieces)
        if np.any(np.diff(table[:, 0]) < 0):
            table = table[np.argsort(table[:, 0], kind="stable")]
        if self._step or len(table) > self._most:
            since = table[:, 0] - self.begin
            self._step = self._step or _FINEST
            while np.count_nonzero(np.diff(since // self._step)) >= self._steps:
                self._step *= 2
            start = self.begin + since // self._step * self._step
            first = np.flatnonzero(np.diff(start, prepend=start[0] - 1))
            table = self._merge(table, first, start[first], self._step)
        self._pieces, self._count = [table], len(table)
        return table.copy(), self._step


_MOTION, _SEEN = 1, 2  # columns of a table of states
_FIRST_RANGE = 3  # where the ranges begin, each with the columns last, low, high


def _merged_states(table: Table, first: Places, start: Places, step: int) -> Table:
    """The states of each step in a row, and what holds after it in another if the next is empty."""
    rows = table[np.append(first[1:], len(table)) - 1]  # the last of each step
    rows[:, 0] = start
    entry = table[first - 1]  # what held when the step began, unless it was set just then
    entered = (table[first, 0] > start) & (first > 0)
    seen = np.bitwise_or.reduceat(table[:, _SEEN], first)
    rows[:, _SEEN] = seen | np.where(entered, 1 << entry[:, _MOTION], 0)
    for value in range(_FIRST_RANGE, table.shape[1], 3):
        low = np.minimum.reduceat(table[:, value + 1], first)
        high = np.maximum.reduceat(table[:, value + 2], first)
        rows[:, value + 1] = np.where(entered, np.minimum(low, entry[:, value]), low)
        rows[:, value + 2] = np.where(entered, np.maximum(high, entry[:, value]), high)
    changing = rows[:, _SEEN] != 1 << rows[:, _MOTION]
    for value in range(_FIRST_RANGE, table.shape[1], 3):
        changing |= rows[:, value + 1] != rows[:, value + 2]
    # More may come in the last step, of which all the same nothing is said beyond it.
    after = rows[:-1][changing[:-1] & (np.diff(rows[:, 0]) != step)]
    both = np.concatenate([rows, _held_after(after, step)])
    return both[np.argsort(both[:, 0], kind="stable")]


def _held_after(rows: Table, step: int) -> Table:
    """What holds after steps with such rows, as long as nothing changes."""
    rows = rows.copy()
    rows[:, 0] += step
    rows[:, _SEEN] = 1 << rows[:, _MOTION]
    for value in range(_FIRST_RANGE, rows.shape[1], 3):
        rows[:, value + 1] = rows[:, value + 2] = rows[:, value]
    return rows


def _merged_latencies(table: Table, first: Places, start: Places, step: int) -> Table:
    """The latencies of each step in a row."""
    kept = zip((np.minimum, np.maximum, np.add), table.T[1:], strict=True)
    return np.column_stack([start, *(one.reduceat(column, first) for one, column in kept)])


def _merged_marks(table: Table, first: Places, start: Places, step: int) -> Table:
    """The first mark of each step, for all in it."""
    amounts = np.add.reduceat(table[:, 1], first)
    return np.column_stack([table[first, 0], amounts, table[first, 2]])


def word_of(protocol: Protocol) -> str | None:
    """The variable whose words a timeline has: the first one that has words; None: none has."""
    return next((name for name, spec in protocol.variables.items() if spec.words), None)


def numbers_of(protocol: Protocol) -> tuple[str, ...]:
    """The variables whose ranges a timeline has: those that are whole numbers."""
    return tuple(n for n, spec in protocol.variables.items() if spec.kind == "whole")
