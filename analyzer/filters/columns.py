"""The values that a filter asks for, as columns of the rows of a batch. Needs numpy.

Numbers and bytes are arrays; words are coded, so that each word of a column is looked at once.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
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
    StateColumns,
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


class Columns:
    """The columns of some rows. A name that none of them has is a column without a value.

    `start` is the wall clock (ns since 1970) at the recording's start, None if it is not known.
    """

    def __init__(self, protocol: Protocol, t: NDArray[np.int64], start: int | None) -> None:
        self._protocol = protocol
        self._t = t
        self._start = start
        self._made: dict[str, Column] = {}

    def __len__(self) -> int:
        return len(self._t)

    def __getitem__(self, key: str) -> Column:
        if key not in self._made:
            space, _, name = key.rpartition(".")
            if space:
                self._made[key] = self._field(name) if space == "fields" else self._state(name)
            elif key in (DATE, TIME_OF_DAY):
                self._made[key] = self._clock(key)
            else:
                self._made[key] = getattr(self, f"_get_{key}", self._none)()
        return self._made[key]

    def _clock(self, key: str) -> Column:
        """The wall clock in ns: since 1970, or since local midnight."""
        if self._start is None:
            return self._none()
        wall = self._t + self._start
        if key == DATE:
            return Numbers(wall)
        step, place = np.unique(wall // STEP, return_inverse=True)
        offsets = np.array([offset(one) for one in step.tolist()], np.int64)
        return Numbers((wall + offsets[place]) % DAY)

    def _none(self) -> Column:
        return Numbers(np.zeros(len(self), np.int64), np.zeros(len(self), np.bool_))

    def _field(self, name: str) -> Column:
        """A field of the instructions."""
        return self._none()

    def _state(self, variable: str) -> Column:
        """A variable of the state, or `moving`."""
        raise NotImplementedError

    def _get_t(self) -> Column:
        return Numbers(self._t / 1e9)


class HostColumns(Columns):
    """The host's rows."""

    def __init__(self, protocol: Protocol, rows: HostRows, start: int | None) -> None:
        super().__init__(protocol, rows.t, start)
        self._rows = rows

    def _field(self, name: str) -> Column:
        rows, protocol = self._rows, self._protocol
        value, present = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.bool_)
        for spec in protocol.instructions:
            header = protocol.header_bytes[spec.id, spec.length]
            for part in spec.fields:
                if part.name == name:
                    found = (rows.header == header) & (rows.kind == INSTRUCTION)
                    values = field_values(part, rows.data, rows.offset[found])
                    if values.dtype.kind != "i":  # wider than 64 bits with a sign
                        value = value.astype(object)
                    value[found] = values
                    present |= found
        return Numbers(value, present)

    def _state(self, variable: str) -> Column:
        return _state(self._rows.states, variable)

    def _of_header(self, place: int) -> Column:
        """The ID or the length in the header."""
        values = np.array([header[place] for header in self._protocol.headers])
        return Numbers(values.take(self._rows.header), self._rows.kind != GARBAGE)

    def _get_id(self) -> Column:
        return self._of_header(0)

    def _get_len(self) -> Column:
        return self._of_header(1)

    def _get_hex(self) -> Octets:
        return Octets(self._rows.data, self._rows.offset, self._rows.size)

    def _get_data(self) -> Octets:
        data, start, size = self._get_hex()
        return Octets(data, start + 1, np.where(self._rows.kind == GARBAGE, -1, size - 1))

    def _get_direction(self) -> Column:
        return _one("host")

    def _get_kind(self) -> Column:
        return Words(self._rows.kind, KINDS)

    def _get_name(self) -> Column:
        known = self._protocol.by_id
        specs = [known.get(identity) for identity, _ in self._protocol.headers]
        code = np.where(self._rows.kind == GARBAGE, np.int64(256), self._rows.header)
        return Words(code, [spec.name if spec else None for spec in (*specs, None)])

    def _get_judgement(self) -> Column:
        return _judgement(self._protocol, self._rows.verdict)

    def _get_faulty(self) -> Column:
        return _truth(self._rows.verdict != VALID)

    def _get_faults(self) -> Column:
        return Words(self._rows.faults.code, list(map(frozenset, self._rows.faults.kinds)))

    def _get_reason(self) -> Column:
        faulty = np.flatnonzero(self._rows.verdict != VALID)
        return _words(self._rows.reasons(faulty), faulty, len(self), "")

    def _get_sequence(self) -> Column:
        return Numbers(self._rows.sequence, self._rows.sequence >= 0)


class DeviceColumns(Columns):
    """The device's rows."""

    def __init__(self, protocol: Protocol, rows: DeviceRows, start: int | None) -> None:
        super().__init__(protocol, rows.t, start)
        self._rows = rows

    def _state(self, variable: str) -> Column:
        return _state(self._rows.states, variable)

    def _get_hex(self) -> Octets:
        return Octets(self._rows.byte, np.arange(len(self)), np.ones(len(self), np.int64))

    def _get_direction(self) -> Column:
        return _one("device")

    def _get_kind(self) -> Column:
        return _one("response")

    def _get_name(self) -> Column:
        codes = [self._protocol.codes.get(byte) for byte in range(256)]
        return Words(self._rows.byte, [code.name if code else None for code in codes])

    def _get_response(self) -> Column:
        return Numbers(self._rows.byte)

    def _get_judgement(self) -> Column:
        return _judgement(self._protocol, self._rows.verdict)

    def _get_faulty(self) -> Column:
        wrong = self._rows.answering & (self._rows.verdict != VALID)
        return _truth(wrong | self._rows.faults.serious)

    def _get_faults(self) -> Column:
        return Words(self._rows.faults.code, list(map(frozenset, self._rows.faults.kinds)))

    def _get_reason(self) -> Column:
        odd = np.flatnonzero(self._rows.odd)
        reasons = [record.reason for record in self._rows.samples(odd)]
        return _words(reasons, odd, len(self), "")

    def _get_answers(self) -> Column:
        return Numbers(self._rows.sequence, self._rows.answering)

    def _get_latency(self) -> Column:
        return Numbers(self._rows.latency / 1e9, self._rows.answering)

    def _get_agrees(self) -> Column:
        return Words(self._rows.agrees + 1, (None, False, True))


class LineColumns(Columns):
    """The other rows, which are few: each is a JSON line."""

    def __init__(
        self, protocol: Protocol, lines: Sequence[JsonLine], t: NDArray[np.int64], start: int | None
    ) -> None:
        super().__init__(protocol, t, start)
        self._lines = lines

    def _state(self, variable: str) -> Column:
        values = [getattr(line.state, variable) for line in self._lines]
        return (
            self._listed(values) if variable in ("motion", "moving") else Numbers(np.array(values))
        )

    def _listed(self, values: Iterable[Hashable]) -> Column:
        return _words(values, np.arange(len(self)), len(self), None)

    def _get_hex(self) -> Octets:
        nothing = np.zeros(len(self), np.int64)
        return Octets(np.zeros(1, np.uint8), nothing, nothing)

    def _get_direction(self) -> Column:
        return self._listed(line.direction for line in self._lines)

    def _get_kind(self) -> Column:
        return self._listed(line.kind for line in self._lines)

    def _get_name(self) -> Column:
        return self._listed(line.name for line in self._lines)

    def _get_faulty(self) -> Column:
        return self._listed(bool(line.faults) for line in self._lines)

    def _get_faults(self) -> Column:
        return self._listed(frozenset(line.faults) for line in self._lines)

    def _get_reason(self) -> Column:
        return self._listed(line.reason for line in self._lines)

    def _get_sequence(self) -> Column:
        numbers = [-1 if line.sequence is None else line.sequence for line in self._lines]
        return Numbers(np.array(numbers), np.array(numbers) >= 0)


def _state(states: StateColumns, variable: str) -> Column:
    if variable == "moving":
        return _truth(states.moving)
    column = states[variable]
    if variable == "motion":
        return Words(column, [motion.value for motion in MOTIONS])
    return Numbers(column)


def _judgement(protocol: Protocol, verdict: NDArray[np.uint8]) -> Column:
    codes = [protocol.answers[outcome].code for outcome in OUTCOMES]
    return Numbers(np.array([*codes, 0]).take(verdict), verdict != NO_VERDICT)


def _truth(mask: Mask) -> Words:
    return Words(mask.view(np.uint8), (False, True))


def _one(word: str) -> Words:
    return Words(np.zeros((), np.int64), (word,))


def _words(
    values: Iterable[Hashable], rows: NDArray[np.int64], count: int, others: Hashable
) -> Words:
    """A column with these values in some of `count` rows, and `others` in all others."""
    places = {others: 0}
    code = np.zeros(count, np.int64)
    code[rows] = [places.setdefault(value, len(places)) for value in values]
    return Words(code, list(places))
