"""What happens in a recording along its time, for a picture: states, latencies and anomalies.

Each of the three has at most so many rows, however long the recording is. Up to then they are
exact; after that a row holds what was in one step of time, whose width doubles as often as need be.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.decode.batch import Batch, Selection
from bilprov.analyzer.decode.records import Record, serious_faults
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
        self._states = _Rows(_merged_states, 3 + 3 * len(self._numbers))
        self._latencies = _Rows(_merged_latencies, 4)
        self._marks = _Marks()
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
        self._add_latencies(devices.t[answering], devices.latency[answering])
        self._add_marks(batch)

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
        return self._marks.reduced()

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
            self._add_idle(np.append(before, times[times > before]))

    def _add_idle(self, times: NDArray[np.int64]) -> None:
        """Take in the times (ns) between which there may be idle ones."""
        times = np.sort(times)
        long = np.flatnonzero(np.diff(times) >= SHORTEST_IDLE)
        ends = zip(times[long].tolist(), times[long + 1].tolist(), strict=True)
        self._idle += ends
        self._idle.sort(key=lambda idle: idle[0] - idle[1])
        del self._idle[MOST_IDLE:]

    def _add_states(
        self,
        t: NDArray[np.int64],
        *values: NDArray[np.signedinteger],
    ) -> None:
        """Take states in order, each with the time (ns) from which on it holds."""
        changed = np.zeros(len(t), np.bool_)
        for column, last in zip(values, self._last, strict=True):
            changed |= np.append(last, column[:-1]) != column
        rows = np.flatnonzero(changed)
        if len(rows):
            self._last = tuple(int(column[-1]) for column in values)
            motion, *numbers = (column.take(rows) for column in values)
            table = np.empty((3 + 3 * len(numbers), len(rows)), np.int64)
            for place, column in enumerate([t.take(rows), motion, 1 << motion.astype(np.int64)]):
                table[place] = column
            for place, column in enumerate(numbers):
                table[3 + 3 * place : 6 + 3 * place] = column
            self._states.add(table.T)

    def _add_marks(self, batch: Batch) -> None:
        sides = (batch.hosts.known, batch.devices.t, batch.others.t)
        found = [np.flatnonzero(mask) for mask in batch.serious]
        if not any(map(len, found)):
            return
        amounts = [
            kinds.amounts.take(kinds.code[rows])
            for kinds, rows in zip((batch.hosts.faults, batch.devices.faults), found, strict=False)
        ]
        amounts.append(np.ones(len(found[2]), np.int64))
        side = np.repeat(np.arange(3), list(map(len, found)))
        rows = np.concatenate(found)

        def made(places: NDArray[np.int64]) -> list[Record]:
            """The records of some of these rows, side by side."""
            return [
                record
                for one in range(3)
                if len(asked := rows[places[side[places] == one]])
                for record in batch.records(_only(one, asked, batch))
            ]

        t = np.concatenate([of[at] for of, at in zip(sides, found, strict=True)])
        self._marks.add(t, np.concatenate(amounts), made)

    def _add_latencies(self, t: NDArray[np.int64], latency: NDArray[np.int64]) -> None:
        self._latencies.add(np.column_stack([t, latency, latency, np.ones(len(t), np.int64)]))


class _Rows:
    """A table of at most `MOST` rows; when there are more, `merge` puts rows together.

    It gets the table, for each row when (ns) its step of time begins, and the width of a step.
    """

    def __init__(self, merge: Callable[[Table, NDArray[np.int64], int], Table], width: int) -> None:
        self._merge = merge
        self._pieces = [np.zeros((0, width), np.int64)]
        self._count = 0
        self._step = 0
        self.begin = 0

    def add(self, table: Table) -> None:
        """Take more rows."""
        self._pieces.append(table)
        self._count += len(table)
        if self._count > 4 * MOST:
            table, _ = self.reduced()
            self._pieces, self._count = [table], len(table)

    def reduced(self) -> tuple[Table, int]:
        """All of the rows, and the width (ns) of the steps, 0 if the rows are exact."""
        table = np.concatenate(self._pieces)
        if np.any(np.diff(table[:, 0]) < 0):
            table = table[np.argsort(table[:, 0], kind="stable")]
        if self._step or len(table) > MOST:
            since = table[:, 0] - self.begin
            self._step = self._step or _FINEST
            # A step may take two rows: one for what changes in it, one for what holds after it.
            while 2 * _distinct(since // self._step) > MOST:
                self._step *= 2
            table = self._merge(table, self.begin + since // self._step * self._step, self._step)
        return table, self._step


_MOTION, _SEEN = 1, 2  # columns of a table of states
_FIRST_RANGE = 3  # where the ranges begin, each with the columns last, low, high


def _merged_states(table: Table, start: NDArray[np.int64], step: int) -> Table:
    """The states of each step in a row, and what holds after it in another if the next is empty."""
    first = np.flatnonzero(np.diff(start, prepend=start[0] - 1))
    last = np.append(first[1:], len(table)) - 1
    rows = table[last]
    rows[:, 0] = start[first]
    entry = table[first - 1]  # what held when the step began, unless it was set just then
    entered = (table[first, 0] > start[first]) & (first > 0)
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


def _merged_latencies(table: Table, start: NDArray[np.int64], step: int) -> Table:
    """The latencies of each step in a row."""
    first = np.flatnonzero(np.diff(start, prepend=start[0] - 1))
    _, low, high, count = table.T
    return np.column_stack(
        [
            start[first],
            np.minimum.reduceat(low, first),
            np.maximum.reduceat(high, first),
            np.add.reduceat(count, first),
        ]
    )


class _Marks:
    """Marks of anomalies, at most `MOST_MARKS`; when there are more, one a step of time."""

    def __init__(self) -> None:
        self._marks: list[Mark] = []
        self._step = 0
        self.begin = 0

    def add(
        self,
        t: NDArray[np.int64],
        amounts: NDArray[np.int64],
        made: Callable[[NDArray[np.int64]], Sequence[Record]],
    ) -> None:
        """Take the records with anomalies at these times (ns), and how many each of them has.

        `made` gives the records of some of them, by their places, which increase.
        """
        if not len(t):
            return
        order = np.argsort(t, kind="stable")
        starts = np.array([mark.t for mark in self._marks], np.int64)
        if not self._step and len(self._marks) + len(t) > MOST_MARKS:
            self._step = _FINEST
        times = np.sort(np.append(starts, t))
        while self._step and _distinct(self._steps(times)) > MOST_MARKS:
            self._step *= 2
        first = np.arange(len(t))
        if self._step:
            first = np.flatnonzero(np.diff(self._steps(t[order]), prepend=-1))
        kept, sums = order[first].tolist(), np.add.reduceat(amounts[order], first).tolist()
        counts = dict(zip(kept, sums, strict=True))
        places = np.sort(order[first])
        for place, record in zip(places.tolist(), made(places), strict=True):
            faults = serious_faults(record)
            kinds = ", ".join(fault.kind for fault in faults)
            reasons = "; ".join(fault.reason for fault in faults)
            self._marks.append(Mark(int(t[place]), counts[place], kinds, reasons))
        self._marks.sort(key=lambda mark: mark.t)
        if self._step:
            steps = self._steps(np.array([mark.t for mark in self._marks], np.int64)).tolist()
            together = groupby(zip(steps, self._marks, strict=True), lambda pair: pair[0])
            self._marks = [_together([mark for _, mark in marks]) for _, marks in together]

    def reduced(self) -> tuple[list[Mark], int]:
        """The marks in order, and the width (ns) of the steps, 0 if each anomaly has its mark."""
        return self._marks, self._step

    def _steps(self, t: NDArray[np.int64]) -> NDArray[np.int64]:
        steps: NDArray[np.int64] = np.maximum(t - self.begin, 0) // self._step
        return steps


def _together(marks: list[Mark]) -> Mark:
    if len(marks) == 1:
        return marks[0]
    return marks[0]._replace(amount=sum(mark.amount for mark in marks))


def _only(side: int, rows: NDArray[np.int64], batch: Batch) -> Selection:
    """These rows of a side, and none of the others."""
    masks = [
        np.zeros(count, np.bool_)
        for count in (len(batch.hosts), len(batch.devices), len(batch.others))
    ]
    masks[side][rows] = True
    return Selection(*masks)


def word_of(protocol: Protocol) -> str | None:
    """The variable whose words a timeline has: the first one that has words; None: none has."""
    return next((name for name, spec in protocol.variables.items() if spec.words), None)


def numbers_of(protocol: Protocol) -> tuple[str, ...]:
    """The variables whose ranges a timeline has: those that are whole numbers."""
    return tuple(n for n, spec in protocol.variables.items() if spec.kind == "whole")


def _distinct(ordered: NDArray[np.int64]) -> int:
    """How many different numbers there are, which never decrease."""
    return int(np.count_nonzero(np.diff(ordered))) + 1
