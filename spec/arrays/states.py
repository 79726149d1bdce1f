"""The predicted state after each of some requests, as columns: by tables of what each kind sets.

A column of a state variable has numbers, as `State.code` makes them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bilprov.spec.arrays.layouts import Bytes, Places, Requests, field_values, part_values
from bilprov.spec.codec import Steps
from bilprov.spec.data import FieldSpec
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import OTHERS, Changed, From, State, VariableSpec, after

_TAIL = 256  # requests in which each variable is mostly set
_WIDER = 16  # times as many before them are searched for those that are not


class Known(NamedTuple):
    """The state that was predicted last, and where requests have an address that of each device."""

    state: State
    by_address: Mapping[int, State] | None


class StateTables:
    """What each kind of requests sets, for so many `kinds`.

    Raises OverflowError for a variable that does not fit into 64 bits, and where the new value of
    one depends on the old one or on an answer.
    """

    def __init__(self, protocol: Protocol, kinds: int) -> None:
        self._state, self._steps = protocol.state_type, Steps(protocol)
        self._layout, part = protocol.layout, protocol.layout.part("address")
        self._broadcast = part.broadcast if part else None
        self._variables = tuple(protocol.variables.values())
        ends = [end for spec in self._variables for end in (spec.low, spec.high)]
        self._number = np.result_type(np.int16, *(np.min_scalar_type(-abs(v) - 1) for v in ends))
        if self._number.kind != "i":
            raise OverflowError("a state variable does not fit into 64 bits")
        # One bit for each variable.
        self._sets = np.zeros(kinds, np.min_scalar_type((1 << len(self._variables)) - 1))
        self._values = {v.name: np.zeros(kinds, self._type(v)) for v in self._variables}
        # Of the variables that are set from a field: by which kind, from which field, and how.
        self._fields: dict[str, list[tuple[int, FieldSpec, From]]] = {}
        answers = [spec.answer.fields for spec in protocol.instructions if spec.answer]
        if any(part.reports for fields in answers for part in fields):
            raise OverflowError("answers report the state")

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
                raise OverflowError(f"{name} is made of its old value")
            if isinstance(value, From):
                assert isinstance(kinds, int)
                self._fields.setdefault(name, []).append((kinds, parts[value.field], value))
            else:
                self._values[name][kinds] = self._state.code(name, value)

    @property
    def has_effects(self) -> bool:
        """Whether any request sets a variable."""
        return bool(self._sets.any())

    def column(self, variable: str, data: Bytes, requests: Requests, before: Known) -> NDArray[Any]:
        """A variable before the requests, and after each of them."""
        if before.by_address is None:
            return self._column(variable, data, requests, before.state.codes)
        found = np.zeros(len(requests.kind) + 1, self._values[variable].dtype)
        found[0] = self._state.code(variable, getattr(before.state, variable))
        to = self._to(data, requests)
        for address in np.unique(to).tolist():
            rows, state = self._heard_by(address, to, before.by_address)
            column = self._column(variable, data, requests.rows(rows), state.codes)
            mine = to[rows] == address
            found[1 + rows[mine]] = column[1:][mine]
        return found

    def last(self, data: Bytes, requests: Requests, before: Known) -> Known:
        """What is known after all of the requests."""
        if before.by_address is None:
            return before._replace(state=self._last(data, requests, before.state))
        to = self._to(data, requests)
        if not len(to):
            return before
        found = {}
        for address in {*before.by_address, *map(self._known_as, np.unique(to))}:
            rows, state = self._heard_by(address, to, before.by_address)
            found[address] = self._last(data, requests.rows(rows), state)
        return Known(found[self._known_as(to[-1])], found)

    def _to(self, data: Bytes, requests: Requests) -> Places:
        """Whom each request is for."""
        part = self._layout.part("address")
        assert part is not None
        return part_values(part, data, requests.offset, requests.end)

    def _known_as(self, address: int) -> int:
        """The address under which the state after a request is known."""
        return OTHERS if address == self._broadcast else int(address)

    def _heard_by(
        self, address: int, to: Places, known: Mapping[int, State]
    ) -> tuple[Places, State]:
        """The requests for a device, those to all too, and its state before."""
        state = known.get(self._known_as(address), known[OTHERS])
        return np.flatnonzero((to == address) | (to == self._broadcast)), state

    def _column(
        self, variable: str, data: Bytes, requests: Requests, before: Sequence[int]
    ) -> NDArray[Any]:
        """As `column`, of one device; `before` are the values of all variables."""
        place, kind = list(self._values).index(variable), requests.kind
        rows = np.flatnonzero(self._sets.take(kind) & self._sets.dtype.type(1 << place))
        kinds = kind.take(rows)
        values = self._values[variable].take(kinds)
        for one, part, source in self._fields.get(variable, ()):
            of_it = np.flatnonzero(kinds == one)
            at = requests.offset.take(rows.take(of_it)) + self._layout.head
            values[of_it] = self._from(variable, source, field_values(part, data, at))
        counts = np.diff(np.append(1 + rows, len(kind) + 1), prepend=0)
        return np.repeat(np.append(np.array([before[place]], values.dtype), values), counts)

    def _from(self, variable: str, source: From, numbers: NDArray[Any]) -> Any:
        """The values of a variable that is set from a field with these numbers."""
        if not source.words:
            return numbers * source.factor
        codes = {number: self._state.code(variable, word) for word, number in source.words}
        return [codes[number] for number in numbers.tolist()]

    def _last(self, data: Bytes, requests: Requests, state: State) -> State:
        """The state after all requests to one device: the last that sets a variable tells."""
        last = requests.rows(self._last_rows(requests.kind))
        for start, end in zip(last.offset.tolist(), last.end.tolist(), strict=True):
            state = after(state, self._steps[data[start:end].tobytes()].sets)
        return state

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
