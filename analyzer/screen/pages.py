"""The rows of a part in the order in which they are shown: records of some, masks over all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, overload

import numpy as np
from bilprov.analyzer.columns.kinds import Kinds, device_kinds, host_kinds
from bilprov.analyzer.columns.stretch import Span, Stretch
from numpy.typing import NDArray

from bilprov.analyzer.decode.json_lines import json_line
from bilprov.analyzer.decode.records import Record, serious_faults

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter
    from bilprov.spec.protocol import Protocol

Mask: TypeAlias = NDArray[np.bool_]

SIDES: tuple[Literal["host", "device", "line"], ...] = ("host", "device", "line")
"""The sides of a stretch's spans; an `Order` has their places."""

_HOST, _DEVICE, _LINE = range(3)


class RecordsPage:
    """The rows of records that are there one by one; `nbytes` counts nothing for them."""

    nbytes = 0

    def __init__(self, listed: Sequence[Record]) -> None:
        self._listed = listed

    def page(self, protocol: Protocol) -> RecordsPage:
        """These rows."""
        return self

    def records(self, rows: Sequence[int]) -> list[Record]:
        """The records of some rows."""
        return [self._listed[row] for row in rows]

    def passing(self, test: Filter, first: int = 0) -> Mask:
        """Which rows from `first` on pass a filter."""
        lines = map(json_line, self._listed[first:])
        return _mask(line is not None and test(line) for line in lines)

    def faulty(self, first: int = 0) -> Mask:
        """Which rows from `first` on have an anomaly that is a warning or an error."""
        listed = self._listed[first:]
        return _mask(bool(record.faults and serious_faults(record)) for record in listed)


class Order(Sequence[Span]):
    """The spans of a stretch, as arrays: of sides, first rows, and host rows that have come then.

    `upto` counts the rows shown before each span, and in all. The spans follow each other with
    these sides (places in SIDES) and numbers of rows; the first `carried` host rows are none's.
    """

    def __init__(self, sides: bytes, counts: NDArray[Any], carried: int) -> None:
        self.side, rows = np.frombuffer(sides, np.uint8), counts.astype(np.int64)
        self.start = np.zeros(len(rows), np.int64)
        for one in range(len(SIDES)):
            of_it = self.side == one
            self.start[of_it] = np.cumsum(rows[of_it]) - rows[of_it]
        self.start[self.side == _HOST] += carried
        self.after = carried + np.cumsum(rows * (self.side == _HOST))
        self.upto = np.append(0, np.cumsum(rows))

    def __len__(self) -> int:
        return len(self.side)

    def __iter__(self) -> Iterator[Span]:
        stop = self.start + np.diff(self.upto)
        sides: Any = map(SIDES.__getitem__, self.side.tolist())
        return map(Span, sides, self.start.tolist(), stop.tolist(), self.after.tolist())

    @overload
    def __getitem__(self, at: int) -> Span: ...
    @overload
    def __getitem__(self, at: slice) -> list[Span]: ...
    def __getitem__(self, at: int | slice) -> Span | list[Span]:
        return list(self)[at]


class StretchPage:
    """The rows of a stretch, whose spans are this order."""

    def __init__(self, part: Stretch, order: Order) -> None:
        self._part = part
        self._side, self._start = order.side, order.start
        self._after, self._upto = order.after, order.upto

    def records(self, rows: Sequence[int]) -> list[Record]:
        """The records of some rows, which increase."""
        asked = np.array(rows, np.int64)
        span = np.searchsorted(self._upto, asked, "right") - 1
        side, place = self._side[span], self._start[span] + asked - self._upto[span]
        part = self._part
        hosts = iter(part.hosts(place[side == _HOST]))
        answers = iter(part.answers(place[side == _DEVICE]))
        found: list[Record] = []
        for of, at, number in zip(side.tolist(), place.tolist(), span.tolist(), strict=True):
            if of == _HOST:
                found.append(next(hosts))
            elif of == _DEVICE:
                state = part.state(int(self._after[number]))
                found.append(part.device_record(next(answers), state))
            else:
                found.append(part.line(at, int(self._after[number])))
        return found

    def passing(self, test: Filter, first: int = 0) -> Mask:
        """Which rows pass a filter; `first` is 0, since a stretch comes whole."""
        host, device = test.masks(self._part)
        return self._shown(host, device, [self._passes(at, test) for at in self._lines()])

    def faulty(self, first: int = 0) -> Mask:
        """Which rows have an anomaly that is a warning or an error."""
        part = self._part
        lines = [bool(serious_faults(part.line(at, part.carried))) for at in self._lines()]
        return self._shown(_serious(host_kinds(part)), _serious(device_kinds(part)), lines)

    def _lines(self) -> range:
        return range(len(self._part.lines))

    def _passes(self, at: int, test: Filter) -> bool:
        span = int(np.flatnonzero((self._side == _LINE) & (self._start == at))[0])
        line = json_line(self._part.line(at, int(self._after[span])))
        return line is not None and test(line)

    def _shown(self, host: Mask, device: Mask, lines: list[bool]) -> Mask:
        """The masks of the sides as one of all rows in order; within a side the order is kept."""
        side = np.repeat(self._side, np.diff(self._upto))
        mask = np.empty(len(side), np.bool_)
        mask[side == _HOST] = host
        mask[side == _DEVICE] = device
        mask[side == _LINE] = lines
        return mask


Page: TypeAlias = RecordsPage | StretchPage
"""The rows of a part, counted from 0."""


def _serious(kinds: Kinds) -> Mask:
    return np.array([bool(kind) for kind in kinds.kinds], np.bool_).take(kinds.code)


def _mask(values: Iterator[bool]) -> Mask:
    return np.fromiter(values, np.bool_)
