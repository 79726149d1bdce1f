"""The predicted state after each of some requests, as columns: by tables of what each kind sets.

A column of a state variable has numbers, as `State.code` makes them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bilprov.spec.arrays.layouts import Bytes, Places, Requests, field_values, part_values
from bilprov.spec.data import FieldSpec
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import OTHERS, Changed, From, State, VariableSpec

_TAIL = 256  # requests in which each variable is mostly set
_WIDER = 16  # times as many before them are searched for those that are not


class Known(NamedTuple):
    """The state that was predicted last, and where requests have an address that of each device."""

    state: State
    by_address: Mapping[int, State] | None


class Reports(NamedTuple):
    """What answers report of the state.

    For each variable that is reported: after which requests (-1: the last one before them), and the
    numbers of its values. The last request before them was to the address `before`.
    """

    variables: Mapping[str, tuple[Places, NDArray[Any]]]
    before: int = OTHERS


NO_REPORTS = Reports({})


class StateTables:
    """What each kind of requests sets, for so many `kinds`.

    Raises OverflowError for a variable that does not fit into 64 bits.
    """

    def __init__(self, protocol: Protocol, kinds: int) -> None:
        self._state = protocol.state_type
        self._layout = protocol.layout
        self._variables = tuple(protocol.variables.values())
        ends = [end for spec in self._variables for end in (spec.low, spec.high)]
        self._number = np.result_type(np.int16, *(np.min_scalar_type(-abs(v) - 1) for v in ends))
        if self._number.kind != "i":
            raise OverflowError("a state variable does not fit into 64 bits")
        # One bit for each variable.
        self._sets = np.zeros(kinds, np.min_scalar_type((1 << len(self._variables)) - 1))
        self._values = {v.name: np.zeros(kinds, self._type(v)) for v in self._variables}
        # Of the variables whose new value may depend on the old one: the place of each kind in a
        # list of changes, from 1 on.
        self._changes: dict[str, tuple[Places, list[Changed]]] = {}
        # Of the variables that are set from a field: by which kind, from which field, and how.
        self._fields: dict[str, list[tuple[int, FieldSpec, From]]] = {}
        answers = [spec.answer.fields for spec in protocol.instructions if spec.answer]
        self._reported = any(part.reports for fields in answers for part in fields)

    def _type(self, variable: VariableSpec) -> np.dtype[Any]:
        if variable.unknown:
            return np.dtype(np.int64)  # which holds NOT_KNOWN
        return np.dtype(np.int8) if variable.words else self._number

    def add(
        self, kinds: int | slice, sets: Iterable[tuple[str, Any]], fields: Iterable[FieldSpec] = ()
    ) -> None:
        """Let a kind, or some, set these variables; `fields` are those of its data."""
        parts = {part.name: part for part in fields}
        for name, value in sets:
            self._sets[kinds] |= 1 << list(self._values).index(name)
            if isinstance(value, Changed):
                made = np.zeros(len(self._sets), np.int64), list[Changed]()
                places, changes = self._changes.setdefault(name, made)
                changes.append(value)
                places[kinds] = len(changes)
            elif isinstance(value, From):
                assert isinstance(kinds, int)
                self._fields.setdefault(name, []).append((kinds, parts[value.field], value))
            else:
                self._values[name][kinds] = self._state.code(name, value)

    @property
    def has_effects(self) -> bool:
        """Whether any request sets a variable, or an answer reports one."""
        return self._reported or bool(self._sets.any())

    def column(self, variable: str, data: Bytes, requests: Requests, before: Known) -> NDArray[Any]:
        """A variable after each request."""
        return self.timeline(variable, data, requests, before, NO_REPORTS)[1:, 0]

    def timeline(
        self, variable: str, data: Bytes, requests: Requests, before: Known, reports: Reports
    ) -> NDArray[Any]:
        """A variable before the requests, and after each of them.

        Where there are reports, beside each value that after the answer to the request.
        """
        if before.by_address is None:
            return self._column(variable, data, requests, before.state.codes, reports)
        wide = 2 if reports.variables else 1
        found = np.zeros((len(requests.kind) + 1, wide), self._values[variable].dtype)
        found[0] = self._state.code(variable, getattr(before.state, variable))
        to = self._to(data, requests)
        for address in {*np.unique(to).tolist(), *([reports.before] if wide > 1 else [])}:
            rows = self._heard_by(address, to)
            codes = self._state_of(address, before.by_address).codes
            own = self._reports_of(address, reports, to, rows)
            column = self._column(variable, data, requests.rows(rows), codes, own)
            mine = to[rows] == address
            found[1 + rows[mine]] = column[1:][mine]
            if wide > 1 and address == reports.before:
                found[0] = column[0]
        return found

    def last(
        self, data: Bytes, requests: Requests, before: Known, reports: Reports = NO_REPORTS
    ) -> Known:
        """What is known after all of the requests and reports."""
        if before.by_address is None:
            codes = self._last(data, requests, before.state.codes, reports)
            return before._replace(state=self._state.of_codes(codes))
        to = self._to(data, requests)
        newest = to[-1:].tolist() or [reports.before] * bool(reports.variables)
        if not newest:
            return before
        found = {}
        for address in {*before.by_address, *map(self._known_as, (*np.unique(to), *newest))}:
            rows = self._heard_by(address, to)
            codes = self._state_of(address, before.by_address).codes
            own = self._reports_of(address, reports, to, rows)
            found[address] = self._state.of_codes(self._last(data, requests.rows(rows), codes, own))
        return Known(found[self._known_as(newest[0])], found)

    def _reports_of(self, address: int, reports: Reports, to: Places, rows: Places) -> Reports:
        """The reports of one device, after which of the requests that it hears."""
        found: dict[str, tuple[Places, NDArray[Any]]] = {}
        for variable, (behind, codes) in reports.variables.items():
            mine = np.append(to, reports.before)[behind] == address
            place = np.where(behind < 0, -1, np.searchsorted(rows, behind))
            found[variable] = place[mine], codes[mine]
        return Reports(found)

    def _to(self, data: Bytes, requests: Requests) -> Places:
        """Whom each request is for."""
        part = self._layout.part("address")
        assert part is not None
        return part_values(part, data, requests.offset, requests.end)

    @property
    def _broadcast(self) -> int | None:
        part = self._layout.part("address")
        return part.broadcast if part else None

    def _known_as(self, address: int) -> int:
        """The address under which the state after a request is known."""
        return OTHERS if address == self._broadcast else int(address)

    def _state_of(self, address: int, known: Mapping[int, State]) -> State:
        return known.get(self._known_as(address), known[OTHERS])

    def _heard_by(self, address: int, to: Places) -> Places:
        """The requests for a device; what is sent to all is for each."""
        return np.flatnonzero((to == address) | (to == self._broadcast))

    def _column(
        self,
        variable: str,
        data: Bytes,
        requests: Requests,
        before: Sequence[int],
        reports: Reports,
    ) -> NDArray[Any]:
        """As `timeline`, of one device; `before` are the values of all variables."""
        place, kind = list(self._values).index(variable), requests.kind
        rows = np.flatnonzero(self._sets.take(kind) & self._sets.dtype.type(1 << place))
        kinds = kind.take(rows)
        values = self._values[variable].take(kinds)
        for one, part, source in self._fields.get(variable, ()):
            of_it = np.flatnonzero(kinds == one)
            at = requests.offset.take(rows.take(of_it)) + self._layout.head
            values[of_it] = self._from(variable, source, field_values(part, data, at))
        changed = self._changes.get(variable)
        change, at, wide = changed[0].take(kinds) if changed else rows, 1 + rows, 1
        if reports.variables:
            behind, codes = reports.variables.get(variable, (rows[:0], values[:0]))
            at, wide = np.concatenate([2 * at, 2 * behind + 3]), 2
            order = np.argsort(at)
            at, values = at[order], np.concatenate([values, codes.astype(values.dtype)])[order]
            change = np.append(change, np.zeros(len(behind), np.int64))[order]
        if changed:
            values = self._changed(variable, change, values, before[place])
        counts = np.diff(np.append(at, wide * (len(kind) + 1)), prepend=0)
        found = np.repeat(np.append(np.array([before[place]], values.dtype), values), counts)
        return found.reshape(-1, wide)

    def _from(self, variable: str, source: From, numbers: NDArray[Any]) -> Any:
        """The values of a variable that is set from a field with these numbers."""
        if not source.words:
            return numbers * source.factor
        codes = {number: self._state.code(variable, word) for word, number in source.words}
        return [codes[number] for number in numbers.tolist()]

    def _changed(
        self, variable: str, change: Places, values: NDArray[Any], before: int
    ) -> NDArray[Any]:
        """The values of a variable, where the new one may be made of the old one by a change.

        `change` is the place of that, from 1 on, and 0 where a value is new.
        """
        state = self._state
        _, changes = self._changes[variable]
        found: list[int] = []
        value = state.value(variable, before)
        for place, code in zip(change.tolist(), values.tolist(), strict=True):
            value = changes[place - 1].value(value) if place else state.value(variable, code)
            found.append(state.code(variable, value))
        return np.array(found, values.dtype)

    def _last(
        self, data: Bytes, requests: Requests, before: Sequence[int], reports: Reports
    ) -> Sequence[int]:
        """The values of all variables after all requests to one device, and reports of it."""
        if not self._changes and not reports.variables:
            # Then the last request that sets a variable tells, for each of them.
            requests = requests.rows(self._last_rows(requests.kind))
        columns = (self._column(name, data, requests, before, reports) for name in self._values)
        return [int(column[-1, -1]) for column in columns]

    def _last_rows(self, kind: Places) -> Places:
        """The last request that sets each of the variables, of those that are set."""
        rows: set[int] = set()
        missing, stop, count = (1 << len(self._variables)) - 1, len(kind), _TAIL
        while missing and stop:
            start = max(0, stop - count)
            sets = self._sets.take(kind[start:stop]) & self._sets.dtype.type(missing)
            found = int(np.bitwise_or.reduce(sets))
            for place in range(len(self._variables)):
                if found >> place & 1:
                    bit = self._sets.dtype.type(1 << place)
                    rows.add(start + int(np.flatnonzero(sets & bit)[-1]))
            missing, stop, count = missing & ~found, start, _WIDER * count
        return np.array(sorted(rows), np.int64)
