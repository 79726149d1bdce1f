"""The values that a filter asks for, as columns of the rows of a batch. Needs numpy.

Numbers and bytes are arrays; words are coded, so that each word of a column is looked at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.decode.batch import (
    GARBAGE,
    INSTRUCTION,
    KINDS,
    NO_VERDICT,
    DeviceRows,
    HostRows,
    Mask,
)
from bilprov.analyzer.decode.json_lines import JsonLine
from bilprov.analyzer.filters.moments import DAY, STEP, offset
from bilprov.analyzer.filters.tree import DATE, TIME_OF_DAY
from bilprov.spec.protocol import Protocol
from bilprov.spec.tables import MOTIONS, OUTCOMES, VALID, field_values


class Numbers(NamedTuple):
    """Numbers, or one for all rows, and in which rows there are any (None: in all)."""

    value: NDArray[Any] | float
    present: Mask | None = None


class Words(NamedTuple):
    """Words or the like: each row's place in `words`, of which one may be None where it lacks."""

    code: NDArray[np.integer]
    words: Sequence[Any]


class Octets(NamedTuple):
    """Bytes: of each row `size` bytes of `data` from `start` on; those with size -1 have none."""

    data: NDArray[np.uint8]
    start: NDArray[np.int64]
    size: NDArray[np.int64]


Column: TypeAlias = Numbers | Words | Octets


Maker: TypeAlias = Callable[[], Column]

NOTHING = Numbers(np.zeros((), np.int64), np.zeros((), np.bool_))
"""The column of a name that none of the rows has."""


class Columns(ABC):
    """The columns of some rows that came at `t` (ns), each made when it is asked for.

    `start` is the wall clock (ns since 1970) at the recording's start, None if it is not known.
    """

    def __init__(self, t: NDArray[np.int64], start: int | None) -> None:
        self._t = t
        self._start = start
        self._columns: dict[str, Column] = {}

    def __len__(self) -> int:
        return len(self._t)

    def __getitem__(self, key: str) -> Column:
        if key not in self._columns:
            self._columns[key] = self._made(key)
        return self._columns[key]

    def _made(self, key: str) -> Column:
        space, _, name = key.rpartition(".")
        if space:
            return self._field(name) if space == "fields" else self._state(name)
        if key == "t":
            return Numbers(self._t / 1e9)
        if key in (DATE, TIME_OF_DAY):
            return self._clock(key)
        make = self._makers().get(key)
        return make() if make else NOTHING

    def _clock(self, key: str) -> Column:
        """The wall clock in ns: since 1970, or since local midnight."""
        if self._start is None:
            return NOTHING
        wall = self._t + self._start
        if key == DATE:
            return Numbers(wall)
        step, place = np.unique(wall // STEP, return_inverse=True)
        offsets = np.array([offset(one) for one in step.tolist()], np.int64)
        return Numbers((wall + offsets[place]) % DAY)

    def _field(self, name: str) -> Column:
        """A field of the instructions."""
        return NOTHING

    @abstractmethod
    def _state(self, variable: str) -> Column:
        """A variable of the state, or `moving`."""

    @abstractmethod
    def _makers(self) -> Mapping[str, Maker]:
        """What makes the other columns that there are."""


class Side(Columns):
    """The rows of one side."""

    def __init__(self, protocol: Protocol, rows: HostRows | DeviceRows, start: int | None) -> None:
        super().__init__(rows.t, start)
        self._protocol = protocol
        self._rows: Any = rows

    def _state(self, variable: str) -> Column:
        states = self._rows.states
        if variable == "moving":
            return _truth(states.moving)
        if variable == "motion":
            return Words(states[variable], [motion.value for motion in MOTIONS])
        return Numbers(states[variable])

    def _judgement(self) -> Column:
        codes = [self._protocol.answers[outcome].code for outcome in OUTCOMES]
        verdict = self._rows.verdict
        return Numbers(np.array([*codes, 0]).take(verdict), verdict != NO_VERDICT)

    def _faults(self) -> Column:
        return Words(self._rows.faults.code, list(map(frozenset, self._rows.faults.kinds)))


class HostColumns(Side):
    """The host's rows."""

    def _makers(self) -> Mapping[str, Maker]:
        rows = self._rows
        return {
            "id": lambda: self._of_header(0),
            "len": lambda: self._of_header(1),
            "hex": lambda: Octets(rows.data, rows.offset, rows.size),
            "data": self._data,
            "direction": lambda: _one("host"),
            "kind": lambda: Words(rows.kind, KINDS),
            "name": self._name,
            "judgement": self._judgement,
            "faulty": lambda: _truth(rows.verdict != VALID),
            "faults": self._faults,
            "reason": self._reason,
            "sequence": lambda: Numbers(rows.sequence, rows.sequence >= 0),
        }

    def _field(self, name: str) -> Column:
        rows = self._rows
        value, present = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.bool_)
        for spec in self._protocol.instructions:
            header = self._protocol.header_bytes[spec.id, spec.length]
            for part in spec.fields:
                if part.name == name:
                    found = (rows.header == header) & (rows.kind == INSTRUCTION)
                    values = field_values(part, rows.data, rows.offset[found])
                    if values.dtype.kind != "i":  # wider than 64 bits with a sign
                        value = value.astype(object)
                    value[found] = values
                    present |= found
        return Numbers(value, present)

    def _of_header(self, place: int) -> Column:
        """The ID or the length in the header."""
        values = np.array([header[place] for header in self._protocol.headers])
        return Numbers(values.take(self._rows.header), self._rows.kind != GARBAGE)

    def _data(self) -> Column:
        size = np.where(self._rows.kind == GARBAGE, -1, self._rows.size - 1)
        return Octets(self._rows.data, self._rows.offset + 1, size)

    def _name(self) -> Column:
        specs = [self._protocol.by_id.get(identity) for identity, _ in self._protocol.headers]
        code = np.where(self._rows.kind == GARBAGE, np.int64(len(specs)), self._rows.header)
        return Words(code, [spec.name if spec else None for spec in (*specs, None)])

    def _reason(self) -> Column:
        faulty = np.flatnonzero(self._rows.verdict != VALID)
        return _words(self._rows.reasons(faulty), faulty, len(self))


class DeviceColumns(Side):
    """The device's rows."""

    def _makers(self) -> Mapping[str, Maker]:
        rows = self._rows
        return {
            "hex": lambda: Octets(rows.byte, np.arange(len(rows)), np.ones(len(rows), np.int64)),
            "direction": lambda: _one("device"),
            "kind": lambda: _one("response"),
            "name": self._name,
            "response": lambda: Numbers(rows.byte),
            "judgement": self._judgement,
            "faulty": self._faulty,
            "faults": self._faults,
            "reason": self._reason,
            "answers": lambda: Numbers(rows.sequence, rows.answering),
            "latency": lambda: Numbers(rows.latency / 1e9, rows.answering),
            "agrees": lambda: Words(rows.agrees + 1, (None, False, True)),
        }

    def _name(self) -> Column:
        codes = [self._protocol.codes.get(byte) for byte in range(256)]
        return Words(self._rows.byte, [code.name if code else None for code in codes])

    def _faulty(self) -> Column:
        wrong = self._rows.answering & (self._rows.verdict != VALID)
        return _truth(wrong | self._rows.faults.serious)

    def _reason(self) -> Column:
        odd = np.flatnonzero(self._rows.odd)
        return _words((record.reason for record in self._rows.samples(odd)), odd, len(self))


class LineColumns(Columns):
    """The other rows, which are few: each is a JSON line."""

    def __init__(self, lines: Sequence[JsonLine], t: NDArray[np.int64], start: int | None) -> None:
        super().__init__(t, start)
        self._lines = lines

    def _state(self, variable: str) -> Column:
        return self._listed(getattr(line.state, variable) for line in self._lines)

    def _makers(self) -> Mapping[str, Maker]:
        lines, none = self._lines, np.zeros(len(self), np.int64)
        return {
            "hex": lambda: Octets(np.zeros(1, np.uint8), none, none),
            "direction": lambda: self._listed(line.direction for line in lines),
            "kind": lambda: self._listed(line.kind for line in lines),
            "name": lambda: self._listed(line.name for line in lines),
            "faulty": lambda: self._listed(bool(line.faults) for line in lines),
            "faults": lambda: self._listed(frozenset(line.faults) for line in lines),
            "reason": lambda: self._listed(line.reason for line in lines),
            "sequence": lambda: self._listed(line.sequence for line in lines),
        }

    def _listed(self, values: Iterable[Any]) -> Column:
        """A column of values of one kind."""
        listed = list(values)
        numbers = [type(value) is int for value in listed]
        if any(numbers):
            return Numbers(np.array([value or 0 for value in listed]), np.array(numbers))
        return _words(listed, np.arange(len(self)), len(self), None)


def _truth(mask: Mask) -> Words:
    return Words(mask.view(np.uint8), (False, True))


def _one(word: str) -> Words:
    return Words(np.zeros((), np.int64), (word,))


def _words(
    values: Iterable[Hashable], rows: NDArray[np.int64], count: int, others: Hashable = ""
) -> Words:
    """A column with these values in some of `count` rows, and `others` in all others."""
    places = {others: 0}
    code = np.zeros(count, np.int64)
    code[rows] = [places.setdefault(value, len(places)) for value in values]
    return Words(code, list(places))
