"""The rows of a stretch by columns: the distinct values of each, and which of them each row has.

The rows are those that `json_lines.json_line` makes of the stretch's records. What differs from row
to row (times, numbers, the state) comes from the stretch's columns; all else from one JSON line for
each distinct frame and answer. Needs numpy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from bilprov.analyzer.columns.stretch import Span, Stretch, written
from bilprov.analyzer.decode.json_lines import JsonLine, json_line
from bilprov.analyzer.decode.records import HostRecord
from bilprov.analyzer.output.row_columns import Column, Value
from bilprov.captures.schemas import State
from bilprov.spec.motion import VARIABLES

_HOST, _DEVICE, _LINE = 0, 1, 2
_SIDES = {"host": _HOST, "device": _DEVICE, "line": _LINE}
_NO_STATE = State("", 0, 0, 0, False)

Places = NDArray[np.int64]


class Cells(NamedTuple):
    """A column: its values, and for each row the place of its own among them."""

    values: Sequence[Value]
    place: Places


class StretchRows:
    """The rows of a stretch, in order. `t` has their times (ns)."""

    def __init__(self, stretch: Stretch) -> None:
        self._stretch = stretch
        self._lines: list[JsonLine] = []  # one for each sort of rows
        # A span of the host or the device has many rows; a line event is one row, or none.
        events = {span: self._event(span) for span in stretch.spans if span.side == "line"}
        spans = [span for span in stretch.spans if events.get(span, 0) is not None]
        count = [1 if span.side == "line" else span.stop - span.start for span in spans]
        whose = np.repeat(np.arange(len(spans)), count)
        begin = np.cumsum(count) - count if count else np.zeros(0, np.int64)
        start = np.array([span.start for span in spans], np.int64)
        self._side = np.array([_SIDES[span.side] for span in spans], np.int64)[whose]
        # A row's number among those of its side: the host's count from the first new one.
        self._number = start[whose] + np.arange(len(whose)) - begin[whose]
        self._number[self._side == _HOST] -= stretch.carried
        self._after = np.array([span.after for span in spans], np.int64)[whose]
        self._sort = np.zeros(len(whose), np.int64)
        self._sort[self._side == _LINE] = [
            place for span in spans if (place := events.get(span)) is not None
        ]
        self._sort[self._side == _HOST] = self._frames()[self._of(_HOST)]
        self._sort[self._side == _DEVICE] = self._answers()[self._of(_DEVICE)]

    def __len__(self) -> int:
        return len(self._side)

    @cached_property
    def t(self) -> NDArray[np.int64]:
        """The time of each row (ns)."""
        times = np.zeros(len(self), np.int64)
        times[self._side == _HOST] = self._stretch.start[self._of(_HOST)]
        times[self._side == _DEVICE] = self._stretch.t[self._of(_DEVICE)]
        lines = np.array([line.t for line in self._stretch.lines], np.int64)
        times[self._side == _LINE] = lines[self._of(_LINE)]
        return times

    def cells(self, column: Column) -> Cells:
        """A column of the rows, for any but `time`, which depends on how it is written."""
        name, value = column.name, column.value
        if name in ("t", "t_ns"):
            times, place = self._times
            return Cells([t if name == "t_ns" else t / 1e9 for t in times], place)
        if name in ("latency", "latency_ns"):
            latencies, place = self._latencies
            return Cells([t if t is None or name[-1] == "s" else t / 1e9 for t in latencies], place)
        if name in ("sequence", "answers"):
            return self._numbers(_HOST if name == "sequence" else _DEVICE)
        if name == "state" or name.startswith("state."):
            states, place = self._states
            return Cells([value(line) for line in states], place)
        return Cells([value(line) for line in self._lines], self._sort)

    def _of(self, side: int) -> NDArray[np.int64]:
        """The numbers of the rows of a side, in order."""
        rows: Places = self._number[self._side == side]
        return rows

    def _event(self, span: Span) -> int | None:
        """The place of a line event's JSON line, None if it has none."""
        line = json_line(self._stretch.line(span.start, span.after))
        if line is None:
            return None
        self._lines.append(line)
        return len(self._lines) - 1

    def _frames(self) -> Places:
        """For each new host row the place of the JSON line of its frame."""
        stretch = self._stretch
        known: dict[bytes, int] = {}
        before = len(self._lines)
        frames = stretch.frame_bytes(slice(stretch.carried, None))
        place = [known.setdefault(frame, before + len(known)) for frame in frames]
        for frame in known:
            judgement = stretch.decoding.steps[frame].judgement
            record = HostRecord(0, 0, 0, "instruction", frame, judgement, 0, _NO_STATE)
            self._add(json_line(record))
        return np.array(place, np.int64)

    def _answers(self) -> Places:
        """For each device row the place of its JSON line; an odd answer has one of its own."""
        stretch = self._stretch
        fits = np.flatnonzero(stretch.fits)
        _, first, sort = np.unique(stretch.byte[fits], return_index=True, return_inverse=True)
        order = np.argsort(first)  # `answers` takes rows in order
        place = np.zeros(len(stretch.byte), np.int64)
        place[fits] = len(self._lines) + np.argsort(order)[sort]
        odd = np.flatnonzero(stretch.odd)
        place[odd] = len(self._lines) + len(first) + np.arange(len(odd))
        for rows in (fits[first[order]], odd):
            for answer in stretch.answers(rows):
                self._add(json_line(stretch.device_record(answer, _NO_STATE)))
        return place

    def _add(self, line: JsonLine | None) -> None:
        assert line is not None
        self._lines.append(line)

    @cached_property
    def _times(self) -> tuple[list[int], Places]:
        times, place = np.unique(self.t, return_inverse=True)
        return times.tolist(), place

    @cached_property
    def _latencies(self) -> tuple[list[int | None], Places]:
        place = np.zeros(len(self), np.int64)  # 0 is None
        if not self._stretch.decoding.paired:
            return [None], place
        own = self._stretch.latency[self._of(_DEVICE)]
        found, where = np.unique(own, return_inverse=True)
        place[self._side == _DEVICE] = 1 + where
        return [None, *found.tolist()], place

    def _numbers(self, side: int) -> Cells:
        """The instructions' numbers: of the host's rows, or of those that answers are for."""
        stretch, own = self._stretch, self._of(side)
        place = np.zeros(len(self), np.int64)
        if side == _DEVICE and not stretch.decoding.paired:
            return Cells([None], place)
        first = stretch.sequence + (stretch.carried if side == _HOST else 0)
        place[self._side == side] = 1 + np.arange(len(own))
        return Cells([None, *(own + first).tolist()], place)

    @cached_property
    def _states(self) -> tuple[list[JsonLine], Places]:
        """A line for each run of host rows with one state, which the rows after them have too."""
        stretch = self._stretch
        columns = stretch.states
        changed = np.zeros(len(stretch.start), np.bool_)
        changed[:1] = True
        for column in columns:
            changed[1:] |= column[1:] != column[:-1]
        run = np.append(0, np.cumsum(changed))  # 0 is the state before them
        first = np.flatnonzero(changed)
        rows: Iterator[tuple[int, ...]] = zip(
            *(column[first].tolist() for column in columns), strict=True
        )
        empty = JsonLine(t=0, kind="", reason="", state=stretch.before)
        states = [empty, *(replace(empty, state=written(*row)) for row in rows)]
        assert len(columns) == len(VARIABLES)
        after = np.where(self._side == _HOST, self._number + 1, self._after - stretch.carried)
        return states, run[np.maximum(after, 0)]
