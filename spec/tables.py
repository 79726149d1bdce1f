"""Lookup tables made from a Protocol, by which whole arrays of frames are judged. Needs numpy.

They say what `codec.judge` and `Effect.apply` say about single frames, by which they are filled.
A column of a state variable has numbers, as `State.code` makes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bilprov.spec.data import FieldSpec
from bilprov.spec.fields import Outcome
from bilprov.spec.numbers import Number
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.state import AnyOf, FromField, FromOld, State, VariableSpec
from bilprov.spec.steps import Steps, data_decide

OUTCOMES = tuple(Outcome)
"""The outcomes in the order of the codes in a column of verdicts; 0 is a valid frame."""


class FrameColumns(NamedTuple):
    """The frames of a buffer, one row each.

    `offset` is where the header is, `key` 256 times the header byte plus the byte behind it (which
    is the next frame's where a frame has no data), `verdict` a place in `OUTCOMES`.
    """

    offset: NDArray[np.int64]
    key: NDArray[np.int64]
    verdict: NDArray[np.uint8]

    def rows(self, rows: slice | list[int]) -> FrameColumns:
        """Some of the rows."""
        return FrameColumns(self.offset[rows], self.key[rows], self.verdict[rows])

    def and_then(self, other: FrameColumns) -> FrameColumns:
        """These rows and those of `other`, of the same buffer."""
        return FrameColumns(
            np.concatenate([self.offset, other.offset]),
            np.concatenate([self.key, other.key]),
            np.concatenate([self.verdict, other.verdict]),
        )


class FrameTables:
    """Tables by header byte and first data byte, for arrays of whole frames.

    Raises OverflowError for a grammar whose fields or state variables do not fit into 64 bits, or
    in which instructions with more than one data byte change old values.
    """

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        if not protocol.plain:
            raise OverflowError("frames of another layout are not decoded by tables")
        self.sizes = np.array([1 + length for length in protocol.lengths], np.int64)
        self.codes = np.array(
            [max(0, protocol.answers[outcome].code) for outcome in OUTCOMES], np.uint8
        )
        self.used = np.isin(np.arange(256), list(protocol.codes))
        self._verdict = np.zeros(1 << 16, np.uint8)
        # Instructions with more than one data byte: their data are judged field by field.
        self._long: dict[int, InstructionSpec] = {}
        self._variables = tuple(protocol.variables.values())
        self._state = protocol.state_type
        ends = [end for spec in self._variables for end in (spec.low, spec.high)]
        self._number = np.result_type(np.int16, *(np.min_scalar_type(-abs(v) - 1) for v in ends))
        sizes = [part.size for spec in protocol.instructions for part in spec.fields]
        if self._number.kind != "i" or max(sizes, default=0) > WIDEST:
            raise OverflowError("a state variable or a field does not fit into 64 bits")
        # One bit for each variable.
        self._sets = np.zeros(1 << 16, np.min_scalar_type((1 << len(self._variables)) - 1))
        self._values = {v.name: np.zeros(1 << 16, self._type(v)) for v in self._variables}
        # The variables whose new value may depend on the old one, with the frames' place in a list
        # of changes, from 1 on.
        self._changes: dict[str, tuple[NDArray[np.uint8], list[FromOld]]] = {}
        steps = Steps(protocol)
        for header in range(256):
            self._fill(header, steps)

    def _type(self, variable: VariableSpec) -> np.dtype[Any]:
        if variable.unknown:
            return np.dtype(np.int64)  # which holds NOT_KNOWN
        return np.dtype(np.int8) if variable.words else self._number

    def _fill(self, header: int, steps: Steps) -> None:
        """Fill the 256 rows of a header from the judgements of its frames."""
        length = self._protocol.lengths[header]
        decided = data_decide(self._protocol, bytes([header]) + bytes(length))
        if decided and length > 1:
            spec = self._protocol.by_id[self._protocol.headers[header][0]]
            effects = (*spec.effect.assignments, *self._protocol.on_fault.assignments)
            if any(isinstance(value, FromOld) for _, value in effects):
                raise OverflowError("changes by longer instructions are not decoded by tables")
            self._long[header] = spec
            return
        for first in range(256 if decided and length else 1):
            data = bytes([first]).ljust(length, b"\0")[:length]
            step = steps[bytes([header]) + data]
            rows = (
                header << 8 | first if decided and length else slice(header << 8, 1 + header << 8)
            )
            self._verdict[rows] = OUTCOMES.index(step.judgement.outcome)
            sets = dict(step.sets)
            for bit, variable in enumerate(self._variables):
                if variable.name in sets:
                    self._sets[rows] |= 1 << bit
                    self._fill_value(variable, rows, sets[variable.name])

    def _fill_value(self, variable: VariableSpec, rows: int | slice, value: Any) -> None:
        if not isinstance(value, FromOld):
            self._values[variable.name][rows] = self._state.code(variable.name, value)
            return
        made = np.zeros(1 << 16, np.uint8), list[FromOld]()
        places, changes = self._changes.setdefault(variable.name, made)
        changes.append(value)
        places[rows] = len(changes)

    def blocks(
        self, data: NDArray[np.uint8], start: int = 0
    ) -> Iterator[tuple[NDArray[np.int64], int]]:
        """Find the headers in `data`, whose byte `start` is one, block by block.

        Yields the offsets of the frames that are complete, and that of the next header.

        Where a frame begins depends on all frames before it. So for each place the place 2^k
        frames on is looked up (k times an array operation); only each 2^k-th frame is then walked
        to one by one, and those between are looked up again.
        """
        spare = int(self.sizes.max())
        block = min(len(data) - start, _BLOCK)
        places = np.arange(block + spare, dtype=np.int64)
        jumps = [np.empty(block + spare, np.int64) for _ in range(_DOUBLINGS + 1)]
        at = start
        for base in range(start, len(data), _BLOCK):
            size = min(len(data) - base, _BLOCK)
            reach = size + spare
            np.take(self.sizes, data[base : base + size], out=jumps[0][:size], mode="clip")
            jumps[0][:size] += places[:size]
            jumps[0][size:reach] = places[size:reach]  # behind the block each place is its own next
            for near, far in pairwise(jumps):
                np.take(near[:reach], near[:reach], out=far[:reach], mode="clip")
            walked = _walk(jumps[-1].data, at - base, size)
            at = base + walked.pop()
            frames = np.array(walked, np.int64)
            for jump in reversed(jumps[:-1]):
                both = np.empty(2 * len(frames), np.int64)
                both[::2] = frames
                np.take(jump, frames, out=both[1::2], mode="clip")
                frames = both
            frames = frames[: np.searchsorted(frames, size)]
            frames += base
            if at > len(data):  # the last frame is not complete, and may end in a block to come
                yield frames[:-1], int(frames[-1])
                return
            yield frames, at

    def offsets(self, data: NDArray[np.uint8], start: int = 0) -> tuple[NDArray[np.int64], int]:
        """The offsets of all complete frames, and that of the first header after them."""
        blocks = list(self.blocks(data, start))
        if not blocks:
            return np.empty(0, np.int64), start
        return np.concatenate([offset for offset, _ in blocks]), blocks[-1][1]

    def frames(self, data: NDArray[np.uint8], offset: NDArray[np.int64]) -> FrameColumns:
        """Judge the whole frames of `data` at these offsets."""
        key = data.take(offset).astype(np.int64) << 8
        key |= data.take(offset + 1, mode="clip")
        verdict = self._verdict.take(key)
        for code, spec in self._long.items():
            rows = np.flatnonzero(key >> 8 == code)
            good = np.ones(len(rows), np.bool_)
            for part in spec.fields:
                value = field_values(part, data, offset[rows] + 1)
                good &= (value >= part.low) & (value <= part.high)
            verdict[rows] = np.where(good, VALID, BAD_DATA)
        return FrameColumns(offset, key, verdict)

    def state(
        self,
        variable: str,
        data: NDArray[np.uint8],
        frames: FrameColumns,
        before: Sequence[int],
    ) -> NDArray[Any]:
        """A state variable after each frame.

        `before` are the values of all variables before the first frame (see `State.codes`).
        """
        place = list(self._values).index(variable)
        rows = np.flatnonzero(self._sets.take(frames.key) & self._sets.dtype.type(1 << place))
        values = self._values[variable].take(frames.key.take(rows))
        for name, more, set_to in self._long_effects(data, frames):
            if name == variable:
                rows = np.concatenate([rows, more])
                values = np.concatenate([values, set_to.astype(values.dtype)])
        if self._long:
            order = np.argsort(rows, kind="stable")
            rows, values = rows[order], values[order]
        if variable in self._changes:
            values = self._changed(variable, frames.key[rows], values, before[place])
        counts = np.diff(np.append(rows, len(frames.key)), prepend=0)
        return np.repeat(np.append(np.array([before[place]], values.dtype), values), counts)

    def last_state(
        self, data: NDArray[np.uint8], frames: FrameColumns, before: Sequence[int]
    ) -> tuple[int, ...]:
        """The values of all variables after all of the frames; `before` is as in `state`."""
        if (
            len(frames.key) and not self._long and not self._changes
        ):  # then the last frame that sets a variable tells, for each of them
            bits = [1 << bit for bit in range(len(self._variables))]
            sets = self._sets.take(frames.key[-_TAIL:])
            if np.bitwise_or.reduce(sets) != sum(bits):  # none of the last frames sets one of them
                sets = self._sets.take(frames.key)
            frames = frames.rows(slice(len(frames.key) - len(sets), None))
            last = {int(rows[-1]) for bit in bits if len(rows := np.flatnonzero(sets & bit))}
            frames = frames.rows(sorted(last))
        if not len(frames.key):
            return tuple(before)
        return tuple(int(self.state(name, data, frames, before)[-1]) for name in self._values)

    def _changed(
        self, variable: str, key: NDArray[np.int64], values: NDArray[Any], before: int
    ) -> NDArray[Any]:
        """The values of a variable, where some frames make the new one of the old one."""
        kind = self._state
        places, changes = self._changes[variable]
        found: list[int] = []
        value = kind.value(variable, before)
        for place, code in zip(places.take(key).tolist(), values.tolist(), strict=True):
            value = changes[place - 1].value(value) if place else kind.value(variable, code)
            found.append(kind.code(variable, value))
        return np.array(found, values.dtype)

    def _long_effects(
        self, data: NDArray[np.uint8], frames: FrameColumns
    ) -> Iterator[tuple[str, NDArray[np.int64], NDArray[np.signedinteger]]]:
        """What frames of more than one data byte set: a variable, the rows, the values."""
        for code, spec in self._long.items():
            rows = np.flatnonzero(frames.key >> 8 == code)
            valid = frames.verdict[rows] == VALID
            for good, effect in ((True, spec.effect), (False, self._protocol.on_fault)):
                where = rows[valid == good]
                for variable, value in effect.assignments:
                    if isinstance(value, FromField):
                        part = next(part for part in spec.fields if part.name == value.field)
                        set_to = field_values(part, data, frames.offset[where] + 1) * value.factor
                    else:
                        set_to = np.full(len(where), self._state.code(variable, value))
                    yield variable, where, set_to


_BLOCK = 1 << 16  # bytes that are tokenized at once; the tables of a block fit into a cache
_DOUBLINGS = 5
_TAIL = 256  # frames in which each variable is mostly set
WIDEST = 7  # bytes of a field whose values, signed or not, all fit into 64 bits
VALID, BAD_DATA = OUTCOMES.index(Outcome.VALID), OUTCOMES.index(Outcome.BAD_DATA)


def field_values(part: FieldSpec, data: NDArray[np.uint8], at: NDArray[np.int64]) -> NDArray[Any]:
    """The value of a field in each of the data that begin `at` some places and carry it."""
    at = at + part.offset
    if part.number and part.size == 1:
        return np.take(_byte_values(part.number), data.take(at))
    if part.number and part.size <= WIDEST:
        return number_values(part.number, data, at)
    raw = data.take(at[:, None] + np.arange(part.size)).view(f"V{part.size}").ravel()
    distinct, place = np.unique(raw, return_inverse=True)
    values = [part.parse(one.tobytes()) for one in distinct]
    return np.take(np.array(values) if values else np.zeros(0, np.int64), place)


def number_values(
    number: Number, data: NDArray[np.uint8], at: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The numbers whose first bytes are at these places of `data`; of at most WIDEST bytes."""
    places = range(number.size) if number.order == "big" else reversed(range(number.size))
    value = np.zeros(len(at), np.int64)
    for place in places:
        value <<= 8
        value |= data.take(at + place)
    if number.signed:
        half = np.int64(1 << 8 * number.size - 1)
        value = (value ^ half) - half
    return value


@lru_cache(maxsize=256)
def _byte_values(number: Number) -> NDArray[np.int64]:
    return np.array([number.parse(bytes([byte])) for byte in range(256)], np.int64)


def moving(kind: type[State], columns: Callable[[str], NDArray[Any]]) -> NDArray[np.bool_]:
    """Whether the device moves in each row: AT_REST, which must be declared, does not hold.

    `columns` gives the column of a variable of this kind of state.
    """
    at_rest = kind.at_rest
    assert at_rest is not None
    terms = [columns(name) == kind.code(name, value) for name, value in at_rest.values.items()]
    both = np.logical_or if isinstance(at_rest, AnyOf) else np.logical_and
    found: NDArray[np.bool_] = np.logical_not(both.reduce(terms))
    return found


@lru_cache(maxsize=8)
def frame_tables(protocol: Protocol) -> FrameTables:
    """The tables of a protocol, made when they are first asked for. Raises OverflowError."""
    return FrameTables(protocol)


def _walk(jumps: memoryview, at: int, end: int) -> list[int]:
    """Follow `jumps` from `at` until `end` is reached; that last place is in the list too."""
    walked = [at]
    while at < end:
        at = jumps[at]
        walked.append(at)
    return walked
