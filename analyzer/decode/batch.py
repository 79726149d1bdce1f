"""Decoded traffic as columns: the one form that everything reads which shows, counts or writes it.

A Batch has the rows of the host, those of the device and the others, each side as arrays, and puts
them in order. A record (`records`) is one row as an object. Who decoded the rows does not matter.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import compress, repeat
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.decode.records import (
    DeviceRecord,
    FaultRecord,
    HostRecord,
    LineRecord,
    Record,
    serious_faults,
    serious_kinds,
)
from bilprov.captures.schemas import FrameKind
from bilprov.spec.arrays.layouts import OUTCOMES, VALID
from bilprov.spec.codec import Judgement
from bilprov.spec.state import NOT_KNOWN, AnyOf, State

Mask: TypeAlias = NDArray[np.bool_]
Integers: TypeAlias = NDArray[np.integer]

KINDS: tuple[FrameKind, ...] = ("instruction", "truncated", "garbage")
"""The kinds of host rows in the order of their codes."""

INSTRUCTION, TRUNCATED, GARBAGE = range(3)

NO_VERDICT = len(OUTCOMES)
"""In a column of verdicts (places in `OUTCOMES`): bytes that are no frame."""


class Selection(NamedTuple):
    """Which of the host's, the device's and the other rows of a batch are meant."""

    host: Mask
    device: Mask
    other: Mask

    def __and__(self, other: Selection) -> Selection:
        return Selection(*(mine & its for mine, its in zip(self, other, strict=True)))

    @property
    def everything(self) -> bool:
        """Whether all rows are meant."""
        return all(bool(mask.all()) for mask in self)


class Counts(NamedTuple):
    """How many frames and answers there are, and anomalies without those of severity info."""

    frames: int
    answers: int
    faults: int


class Kinds(NamedTuple):
    """Each row's place in `kinds`, which has the kinds of its anomalies without those of info."""

    code: Integers
    kinds: Sequence[tuple[str, ...]]

    def of(self, mask: Mask | None) -> Kinds:
        """Those of some rows."""
        return self if mask is None else Kinds(self.code[mask], self.kinds)

    @property
    def amounts(self) -> NDArray[np.int64]:
        """How many each of `kinds` are."""
        return np.array([len(kinds) for kinds in self.kinds], np.int64)

    @property
    def serious(self) -> Mask:
        """Which rows have one."""
        return self.amounts.take(self.code) > 0


class StateColumns:
    """The predicted state of rows: `columns[variable]` is an array, of `State.code`.

    `kind` is the class of the states; `made` makes a column.
    """

    def __init__(self, kind: type[State], count: int, made: Callable[[str], NDArray[Any]]) -> None:
        self.kind = kind
        self._count = count
        self._made = cache(made)

    def __getitem__(self, variable: str) -> NDArray[Any]:
        return self._made(variable)

    @property
    def moving(self) -> Mask:
        """Whether the device is not at rest; nowhere if the grammar does not say when it is."""
        at_rest = self.kind.at_rest
        if at_rest is None:
            return np.zeros(self._count, np.bool_)
        terms = [self[name] == self.kind.code(name, one) for name, one in at_rest.values.items()]
        both = np.logical_or if isinstance(at_rest, AnyOf) else np.logical_and
        return np.asarray(~both.reduce(terms))

    @cached_property
    def states(self) -> NDArray[np.object_]:
        """The state of each row as it is written; neighbours with one state share one object."""
        kind, count = self.kind, self._count
        columns = {variable: self[variable] for variable in kind.variables}
        changed = np.arange(count) == 0
        for column in columns.values():
            changed[1:] |= column[1:] != column[:-1]
        values = [_values(kind, name, one[changed]).tolist() for name, one in columns.items()]
        if kind.at_rest is not None:
            values.append(self.moving[changed].tolist())
        return repeated(map(kind, *values) if values else repeat(kind()), changed)


@dataclass(frozen=True, eq=False)
class HostRows:
    """The host's rows: frames, whole or cut short, and garbage.

    `t`, `end` and `known` (ns) are the times of the first and the last byte, and when it was known
    that no more follow. A row has `size` bytes of `data` from `offset` on. `kind` is a place in
    `KINDS`, `verdict` one in `OUTCOMES` or NO_VERDICT, `sequence` the instruction's number or -1.
    `samples` gives records of some rows (with a state that may be another). `header` is the key of
    each row, as `Judgement.key`, whose ID is in `Protocol.keys`. `due` tells to which an answer is
    due; None: to every frame. Those that may not be one frame are `uncertain`.
    """

    t: NDArray[np.int64]
    end: NDArray[np.int64]
    known: NDArray[np.int64]
    kind: NDArray[np.uint8]
    data: NDArray[np.uint8]
    offset: NDArray[np.int64]
    size: NDArray[np.int64]
    verdict: NDArray[np.uint8]
    sequence: NDArray[np.int64]
    states: StateColumns
    samples: Callable[[NDArray[np.int64]], Sequence[HostRecord]]
    header: NDArray[np.uint8]
    due: Mask | None
    uncertain: Mask

    def __len__(self) -> int:
        return len(self.t)

    @cached_property
    def faults(self) -> Kinds:
        """The anomalies, each of which was found at `known`."""
        code = np.where(self.verdict == VALID, 0, 1 + self.kind)
        return Kinds(code, [(), ("faulty instruction",), ("truncated",), ("garbage",)])


@dataclass(frozen=True, eq=False)
class DeviceRows:
    """The device's rows, one an answer: when it came (`t`, ns), and which instruction it answers.

    That one's number (`sequence`, -1 where it answers none), key (`header`) and verdict. `byte` is
    the answer's code (-1: it has none). It has `size` bytes of `data` from `offset` on. `name` is
    the place of its name in `names`; an answer that is damaged has none (None), nor has an unused
    byte, whose place is the byte itself. The fields of its data are in `fields_size` bytes from
    `fields_at` on; -1 where it has no fields. `address` is whose it is, -1 if not known.

    `latency` (ns) is from the
    instruction's last byte on, and `agrees` 1 where the answer is the expected one, 0 where not, -1
    where nothing is expected. `odd` rows have an anomaly: `samples` gives records of some of them
    (with a state that may be another), and `sort` numbers, which are equal where the kinds of the
    anomalies are.
    """

    t: NDArray[np.int64]
    byte: Integers
    sequence: NDArray[np.int64]
    header: NDArray[np.uint8]
    verdict: NDArray[np.uint8]
    latency: NDArray[np.int64]
    agrees: NDArray[np.int8]
    odd: Mask
    states: StateColumns
    samples: Callable[[NDArray[np.int64]], Sequence[DeviceRecord]]
    sort: Callable[[NDArray[np.int64]], Integers]
    data: NDArray[np.uint8]
    offset: NDArray[np.int64]
    size: NDArray[np.int64]
    name: Integers
    names: Sequence[str | None]
    fields_at: NDArray[np.int64]
    fields_size: NDArray[np.int64]
    address: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.t)

    @cached_property
    def answering(self) -> Mask:
        """Which rows answer an instruction."""
        return self.sequence >= 0

    @cached_property
    def faults(self) -> Kinds:
        """The anomalies, each of which was found at `t`."""
        odd = np.flatnonzero(self.odd)
        if not len(odd):  # as mostly
            return Kinds(np.zeros(len(self), np.int64), [()])
        _, first, place = np.unique(self.sort(odd), return_index=True, return_inverse=True)
        code = np.zeros(len(self), np.int64)
        code[odd] = 1 + place
        order = np.argsort(first)  # records are made in order
        kinds: list[tuple[str, ...]] = [()] * (len(first) + 1)
        for at, record in zip(order.tolist(), self.samples(odd[first[order]]), strict=True):
            kinds[1 + at] = serious_kinds(record)
        return Kinds(code, kinds)


@dataclass(frozen=True, eq=False)
class OtherRows:
    """Line events, and anomalies without bytes of their own."""

    listed: Sequence[LineRecord | FaultRecord]

    def __len__(self) -> int:
        return len(self.listed)

    @cached_property
    def t(self) -> NDArray[np.int64]:
        """The times (ns)."""
        return times([record.t for record in self.listed])


class Batch(ABC):
    """Some decoded traffic, in rows."""

    @property
    @abstractmethod
    def hosts(self) -> HostRows:
        """The host's rows."""

    @property
    @abstractmethod
    def devices(self) -> DeviceRows:
        """The device's rows."""

    @property
    @abstractmethod
    def others(self) -> OtherRows:
        """The other rows."""

    @property
    @abstractmethod
    def places(self) -> tuple[NDArray[np.int64], ...]:
        """The numbers of the host's, the device's and the other rows among all rows in order."""

    @abstractmethod
    def __len__(self) -> int:
        """How many rows there are."""

    @abstractmethod
    def records(self, chosen: Selection | None = None) -> Sequence[Record]:
        """The rows in order as records; the chosen ones, None for all."""

    def selection(self, rows: Mask) -> Selection:
        """Some of all rows in order."""
        return Selection(*(rows[places] for places in self.places))

    def in_order(self, chosen: Selection) -> Mask:
        """Which of all rows in order are chosen."""
        rows = np.zeros(len(self), np.bool_)
        if any(mask.any() for mask in chosen):  # the order of all rows takes a while
            for places, mask in zip(self.places, chosen, strict=True):
                rows[places] = mask
        return rows

    def inside(self, first: int | None, after: int | None) -> Selection:
        """The rows with `first <= t < after` (ns; None: no bound)."""
        sides = (self.hosts.t, self.devices.t, self.others.t)
        low = -math.inf if first is None else first
        high = math.inf if after is None else after
        return Selection(*((t >= low) & (t < high) for t in sides))

    @cached_property
    def counts(self) -> Counts:
        """How many frames, answers and anomalies there are."""
        sides = (self.hosts.faults, self.devices.faults)
        faults = sum(int(kinds.amounts.take(kinds.code).sum()) for kinds in sides)
        faults += sum(len(serious_faults(record)) for record in self.others.listed)
        frames = int(np.count_nonzero(self.hosts.verdict != NO_VERDICT))
        return Counts(frames, len(self.devices), faults)

    @property
    def serious(self) -> Selection:
        """The rows with an anomaly that is a warning or an error."""
        other = np.array([bool(serious_faults(one)) for one in self.others.listed], np.bool_)
        return Selection(self.hosts.faults.serious, self.devices.faults.serious, other)


class Records(Batch):
    """Rows that were decoded one by one."""

    def __init__(self, listed: Sequence[Record]) -> None:
        self._listed = listed

    def __reduce__(self) -> tuple[Any, ...]:
        return Records, (self._listed,)  # without what is worked out from them

    def __len__(self) -> int:
        return len(self._listed)

    @cached_property
    def counts(self) -> Counts:
        """How many frames, answers and anomalies there are."""
        frames = answers = faults = 0
        for record in self._listed:  # in one go, since a line of its own makes many small batches
            if type(record) is DeviceRecord:
                answers += 1
            elif type(record) is HostRecord and record.judgement:
                frames += 1
                if record.judgement.valid:
                    continue
            if record.faults:
                faults += len(serious_faults(record))
        return Counts(frames, answers, faults)

    def records(self, chosen: Selection | None = None) -> Sequence[Record]:
        """The rows in order as records; the chosen ones, None for all."""
        if chosen is None:
            return self._listed
        return list(compress(self._listed, self.in_order(chosen).tolist()))

    @cached_property
    def hosts(self) -> HostRows:
        """The host's rows."""
        listed = [record for record in self._listed if isinstance(record, HostRecord)]
        judged = [record.judgement for record in listed]
        data, offset, size = _bytes_of(listed)
        return HostRows(
            t=times([record.t for record in listed]),
            end=times([record.end for record in listed]),
            known=times([record.known for record in listed]),
            kind=np.array([KINDS.index(record.kind) for record in listed], np.uint8),
            data=data,
            offset=offset,
            size=size,
            verdict=_verdicts(judged),
            sequence=_numbers([record.sequence for record in listed]),
            states=_states_of(listed),
            samples=lambda rows: [listed[row] for row in rows.tolist()],
            header=np.array([one.key if one else 255 for one in judged], np.uint8),
            due=np.array([bool(one and one.answer_due) for one in judged], np.bool_),
            uncertain=np.array([record.uncertain for record in listed], np.bool_),
        )

    @cached_property
    def devices(self) -> DeviceRows:
        """The device's rows."""
        listed = [record for record in self._listed if isinstance(record, DeviceRecord)]
        answered = [record.answered for record in listed]
        data, offset, size = _bytes_of(listed)
        # The place of a single byte is the byte; that of other answers counts their names.
        single = any(record.reply is None for record in listed)
        names: list[str | None] = [None] * 256 if single else []
        name = [record.byte for record in listed]
        places: dict[str | None, int] = {}
        for row, record in enumerate(listed):
            if single:
                names[record.byte] = record.name
            else:
                name[row] = places.setdefault(record.name, len(places))
        replies = [record.reply for record in listed]
        around = [(one.head, one.tail) if one else (0, 0) for one in replies]
        head, tail = np.array(around, np.int64).reshape(-1, 2).T
        has_fields = np.array([bool(one and one.fields) for one in replies], np.bool_)
        return DeviceRows(
            t=times([record.t for record in listed]),
            byte=np.array([record.byte for record in listed], np.int64),
            sequence=_numbers([record.instruction for record in listed]),
            header=np.array([one.key if one else 0 for one in answered], np.uint8),
            verdict=_verdicts(answered),
            latency=times([record.latency or 0 for record in listed]),
            agrees=_numbers([record.agrees for record in listed]).astype(np.int8),
            odd=np.array([bool(record.faults) for record in listed], np.bool_),
            states=_states_of(listed),
            samples=lambda rows: [listed[row] for row in rows.tolist()],
            sort=lambda rows: rows,
            data=data,
            offset=offset,
            size=size,
            name=np.array(name, np.int64),
            names=names or list(places),
            fields_at=offset + head,
            fields_size=np.where(has_fields, size - head - tail, -1),
            address=_numbers([one.address if one else None for one in replies]),
        )

    @cached_property
    def others(self) -> OtherRows:
        """The other rows."""
        return OtherRows([r for r in self._listed if isinstance(r, LineRecord | FaultRecord)])

    @cached_property
    def places(self) -> tuple[NDArray[np.int64], ...]:
        """The numbers of the host's, the device's and the other rows among all rows in order."""
        sides = {HostRecord: 0, DeviceRecord: 1}
        side = np.array([sides.get(type(record), 2) for record in self._listed])
        return tuple(np.flatnonzero(side == one) for one in range(3))


def times(values: Sequence[int]) -> NDArray[np.int64]:
    """Times (ns) as an array."""
    return np.array(values, np.int64)


def sliced(
    data: NDArray[np.uint8], start: NDArray[np.int64], end: NDArray[np.int64]
) -> list[bytes]:
    """The bytes from each start to its end."""
    if not len(start):
        return []
    low = int(start.min())
    taken = data[low : int(end.max())].tobytes()
    slices = map(slice, (start - low).tolist(), (end - low).tolist())
    return list(map(taken.__getitem__, slices))


def _values(kind: type[State], variable: str, codes: NDArray[Any]) -> NDArray[np.object_]:
    """The values of a variable with these numbers."""
    words = np.array(kind.words.get(variable), object)
    values = words.take(codes, mode="clip") if words.ndim else codes.astype(object)
    values[codes == NOT_KNOWN] = None
    return values


def repeated(values: Iterable[Any], changed: Mask) -> NDArray[np.object_]:
    """The next of the values at each row that has changed, and the same again at those behind."""
    distinct = np.fromiter(values, object, np.count_nonzero(changed))
    return distinct.take(np.cumsum(changed) - 1)


def _numbers(values: Sequence[int | None]) -> NDArray[np.int64]:
    return np.array([-1 if value is None else value for value in values], np.int64)


def _states_of(records: Sequence[HostRecord] | Sequence[DeviceRecord]) -> StateColumns:
    kind = type(records[0].state) if records else State

    def made(variable: str) -> NDArray[Any]:
        return np.array([kind.code(variable, getattr(one.state, variable)) for one in records])

    return StateColumns(kind, len(records), made)


def _bytes_of(
    records: Sequence[HostRecord] | Sequence[DeviceRecord],
) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]:
    """The bytes of records one after the other, where each begins, and how many it has."""
    data = [record.data for record in records]
    size = np.array([len(part) for part in data], np.int64)
    return np.frombuffer(b"".join(data), np.uint8), np.cumsum(size) - size, size


def _verdicts(judged: Sequence[Judgement | None]) -> NDArray[np.uint8]:
    codes = [OUTCOMES.index(one.outcome) if one else NO_VERDICT for one in judged]
    return np.array(codes, np.uint8)
