"""What a filter means for columns: a mask over the rows of a Stretch. Needs numpy.

A mask holds for the same rows as the filter for their JSON lines. Columns are compared as arrays;
texts are coded, so that each word of a column is compared once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.columns.stretch import Stretch
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord
from bilprov.analyzer.output.filter_tree import (
    COMPARISONS,
    MISSING,
    Comparison,
    Constant,
    Joined,
    Name,
    Node,
    Not,
    Values,
    getter,
)
from bilprov.analyzer.output.json_lines import json_line
from bilprov.spec.tables import MOTIONS, OUTCOMES, moving

Mask: TypeAlias = NDArray[np.bool_]


class Numbers(NamedTuple):
    """Numbers, and in which rows there are any (None: in all)."""

    value: NDArray[Any]
    present: Mask | None = None


class Coded(NamedTuple):
    """Anything else: each row's place in `words`, of which one may be MISSING."""

    code: NDArray[np.integer]
    words: Sequence[Any]


Column: TypeAlias = Numbers | Coded

_EXACT = 1 << 53  # whole numbers up to this are told apart as floats
_WHOLE_TABLE = 4096  # pairs of words that are compared even if few of them occur
_UFUNCS: dict[str, Callable[[Any, Any], Any]] = {
    "==": np.equal,
    "!=": np.not_equal,
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
}


def masks(tree: Node, stretch: Stretch) -> tuple[Mask, Mask]:
    """In which of the new host rows, and in which device rows, a condition is true."""
    host, device = _HostRows(stretch), _DeviceRows(stretch)
    return host.mask(tree), device.mask(tree)


class _Rows(ABC):
    """The rows of one side of a stretch; `column` gives the values of a name."""

    def __init__(self, stretch: Stretch, count: int) -> None:
        self._stretch = stretch
        self._count = count
        self._protocol = stretch.decoding.protocol

    def mask(self, node: Node) -> Mask:
        """In which rows a condition is true."""
        if not self._count:
            return np.zeros(0, np.bool_)
        return np.broadcast_to(self._true(node), self._count)

    def _true(self, node: Node) -> Mask:
        match node:
            case Joined(every=every, parts=parts):
                join = np.logical_and if every else np.logical_or
                true = self._true(parts[0])
                for part in parts[1:]:
                    true = join(true, self._true(part))
                return true
            case Not(part=part):
                return ~self._true(part)
            case Comparison():
                return self._comparison(node)
        column = self._column(node)
        assert isinstance(column, Coded)
        return _held(column, Coded(np.zeros((), np.int64), (True,)), "==")

    def _comparison(self, node: Comparison) -> Mask:
        try:
            true: Mask = np.ones((), np.bool_)
            left = node.first
            for sign, right in node.steps:
                true = true & self._compared(left, sign, right)
                left = right
        except _NoColumnError:
            return self._by_row(node)
        return true

    def _compared(self, left: Node, sign: str, right: Node) -> Mask:
        column = self._column(left)
        if not (sign.endswith("in") and isinstance(right, Values)):
            return _held(column, self._column(right), sign)
        found: Mask = np.zeros((), np.bool_)
        for part in right.parts:
            found = found | _held(column, self._column(part), "==")
        return found if sign == "in" else _present(column) & ~found

    def _column(self, node: Node) -> Column:
        """The values of a node. Raises _NoColumnError."""
        match node:
            case Constant(kind="number", value=value):
                return _number(value)
            case Constant(value=value):
                return Coded(np.zeros((), np.int64), (value,))
            case Name(key=key):
                return self.column(key)
            case Values(parts=parts):
                constants = tuple(part.value for part in parts if isinstance(part, Constant))
                if len(constants) < len(parts):
                    raise _NoColumnError
                return Coded(np.zeros((), np.int64), (constants,))
        return Coded(self._true(node).astype(np.int64), (False, True))

    def _by_row(self, node: Node) -> Mask:
        """The same one by one, for what no array operation does."""
        holds = getter(node)
        lines = map(json_line, self.records())
        return np.fromiter((holds(line) is True for line in lines if line), np.bool_, self._count)

    def column(self, key: str) -> Column:
        """The values of a name."""
        if key == "faulty":
            faults = self._faults
            return Coded(faults.code, [bool(kinds) for kinds in faults.words])
        if key == "faults":
            return self._faults
        space, _, name = key.rpartition(".")
        if space == "fields":
            return self._field(name)
        if space == "state":
            return self._state(name)
        made: Column = getattr(self, f"_{key}")()
        return made

    @abstractmethod
    def records(self) -> Iterable[HostRecord | DeviceRecord]:
        """The records of the rows."""

    @property
    @abstractmethod
    def _faults(self) -> Coded:
        """The kinds of each row's anomalies."""

    @abstractmethod
    def _field(self, name: str) -> Numbers:
        """A field of the instructions."""

    @abstractmethod
    def _state(self, variable: str) -> Column:
        """A variable of the state, or `moving`."""

    def _missing(self) -> Coded:
        return Coded(np.zeros((), np.int64), (MISSING,))


class _HostRows(_Rows):
    """The new host rows."""

    def __init__(self, stretch: Stretch) -> None:
        super().__init__(stretch, stretch.host_rows)

    def records(self) -> Iterable[HostRecord]:
        return self._stretch.hosts(slice(self._stretch.carried, None))

    @cached_property
    def _faults(self) -> Coded:
        verdict = self._stretch.new.verdict
        words: list[tuple[str, ...]] = [()] * len(OUTCOMES)
        for place in np.flatnonzero(np.bincount(verdict)).tolist():
            row = self._stretch.carried + int(np.argmax(verdict == place))
            (frame,) = self._stretch.frame_bytes(np.array([row]))
            judgement = self._stretch.decoding.steps[frame].judgement
            # Neither times nor the state matter: the stretch need not work out its states.
            before = self._stretch.before
            words[place] = _kinds(HostRecord(0, 0, 0, "instruction", frame, judgement, 0, before))
        return Coded(verdict, words)

    @cached_property
    def _frames(self) -> tuple[NDArray[np.int64], list[bytes]]:
        """The place of each row's bytes among all that differ."""
        places: dict[bytes, int] = {}
        frames = self._stretch.frame_bytes(slice(self._stretch.carried, None))
        code = (places.setdefault(frame, len(places)) for frame in frames)
        return np.fromiter(code, np.int64, self._count), list(places)

    def _field(self, name: str) -> Numbers:
        frames, protocol = self._stretch.new, self._protocol
        header = frames.key >> 8
        value = np.zeros(self._count, np.int64)
        present = np.zeros(self._count, np.bool_)
        for spec in protocol.instructions:
            for part in spec.fields:
                if part.name == name:
                    rows = np.flatnonzero(header == protocol.header_bytes[spec.id, spec.length])
                    offset = frames.offset[rows]
                    value[rows] = self._stretch.decoding.tables.field(
                        part, self._stretch.data, offset
                    )
                    present[rows] = True
        return Numbers(_floats(value), present)

    def _state(self, variable: str) -> Column:
        states = self._stretch.states
        if variable == "moving":
            return Coded(moving(states.motion, states.speed).view(np.uint8), (False, True))
        column = getattr(states, variable)
        return _motion_words(column) if variable == "motion" else Numbers(_floats(column))

    def _direction(self) -> Coded:
        return _constant("host")

    def _kind(self) -> Coded:
        return _constant("instruction")

    def _name(self) -> Coded:
        known = self._protocol.by_id
        specs = [known.get(identity) for identity, _ in self._protocol.headers]
        return Coded(self._stretch.new.key >> 8, [s.name if s else MISSING for s in specs])

    def _hex(self) -> Coded:
        code, frames = self._frames
        return Coded(code, [frame.hex(" ") for frame in frames])

    def _reason(self) -> Coded:
        code, frames = self._frames
        steps = self._stretch.decoding.steps
        return Coded(code, [steps[frame].judgement.reason for frame in frames])

    def _judgement(self) -> Coded:
        answers = self._protocol.answers
        return Coded(self._stretch.new.verdict, [answers[outcome].name for outcome in OUTCOMES])

    def _t(self) -> Numbers:
        return Numbers(self._stretch.start / 1e9)

    def _sequence(self) -> Numbers:
        return _counted(self._stretch.sequence + self._stretch.carried, self._count)

    def _latency(self) -> Numbers:
        return _NONE

    _answers = _latency

    def _agrees(self) -> Coded:
        return self._missing()


class _DeviceRows(_Rows):
    """The device rows."""

    def __init__(self, stretch: Stretch) -> None:
        super().__init__(stretch, len(stretch.byte))
        self._paired = stretch.decoding.paired

    def records(self) -> Iterable[DeviceRecord]:
        stretch = self._stretch
        host, device = np.zeros(stretch.host_rows, np.bool_), np.ones(self._count, np.bool_)
        for record in stretch.chosen(host, device, [False] * len(stretch.lines)):
            if isinstance(record, DeviceRecord):
                yield record

    @cached_property
    def _odd(self) -> tuple[NDArray[np.int64], list[DeviceRecord]]:
        """The rows with an anomaly, and a record of each (with a state that may be another)."""
        stretch = self._stretch
        rows = np.flatnonzero(~stretch.fits)
        return rows, [
            stretch.device_record(answer, stretch.before) for answer in stretch.answers(rows)
        ]

    def _of_odd(self, usual: Any, get: Callable[[DeviceRecord], Any]) -> Coded:
        """What only rows with an anomaly have otherwise than `usual`."""
        rows, records = self._odd
        words = {usual: 0}
        code = np.zeros(self._count, np.int64)
        code[rows] = [words.setdefault(get(record), len(words)) for record in records]
        return Coded(code, list(words))

    @cached_property
    def _faults(self) -> Coded:
        return self._of_odd((), _kinds)

    @cached_property
    def _after(self) -> NDArray[np.int64]:
        """How many new host rows have taken effect before each row."""
        spans = [span for span in self._stretch.spans if span.side == "device"]
        after = np.array([span.after for span in spans], np.int64) - self._stretch.carried
        return np.repeat(np.maximum(after, 0), [span.stop - span.start for span in spans])

    def _field(self, name: str) -> Numbers:
        return _NONE

    def _state(self, variable: str) -> Column:
        before = self._stretch.before
        if variable == "moving":
            motion, speed = self._state("motion"), self._state("speed")
            assert isinstance(motion, Coded)
            assert isinstance(speed, Numbers)
            return Coded(moving(motion.code, speed.value).view(np.uint8), (False, True))
        column: NDArray[Any] = getattr(self._stretch.states, variable)
        first = getattr(before, variable)
        if variable == "motion":
            first = MOTIONS.index(first)
        values = np.concatenate([np.array([first], column.dtype), column]).take(self._after)
        return _motion_words(values) if variable == "motion" else Numbers(_floats(values))

    def _direction(self) -> Coded:
        return _constant("device")

    def _kind(self) -> Coded:
        return _constant("response")

    def _name(self) -> Coded:
        codes = [self._protocol.codes.get(byte) for byte in range(256)]
        return Coded(self._stretch.byte, [code.name if code else MISSING for code in codes])

    def _hex(self) -> Coded:
        return Coded(self._stretch.byte, [f"{byte:02x}" for byte in range(256)])

    def _reason(self) -> Coded:
        return self._of_odd("", lambda record: record.reason)

    def _judgement(self) -> Coded:
        if not self._paired:
            return self._missing()
        answers = self._protocol.answers
        verdict = self._stretch.frames.verdict[: self._count]
        return Coded(verdict, [answers[outcome].name for outcome in OUTCOMES])

    def _t(self) -> Numbers:
        return Numbers(self._stretch.t / 1e9)

    def _answers(self) -> Numbers:
        return _counted(self._stretch.sequence, self._count) if self._paired else _NONE

    def _latency(self) -> Numbers:
        return Numbers(self._stretch.latency / 1e9) if self._paired else _NONE

    def _sequence(self) -> Numbers:
        return _NONE

    def _agrees(self) -> Coded:
        if self._paired:
            return Coded(self._stretch.agrees.astype(np.int64), (False, True))
        return self._of_odd(MISSING, lambda record: record.agrees)


class _NoColumnError(Exception):
    """A value that is not the same for all rows and is no column."""


_NONE = Numbers(np.zeros(()), np.zeros((), np.bool_))


def _motion_words(code: NDArray[np.integer]) -> Coded:
    return Coded(code, [motion.value for motion in MOTIONS])


def _constant(word: str) -> Coded:
    return Coded(np.zeros((), np.int64), (word,))


def _kinds(record: HostRecord | DeviceRecord) -> tuple[str, ...]:
    line = json_line(record)
    return line.faults if line else ()


def _number(value: float | str) -> Numbers:
    """A constant; one that no float is equal to is compared as Python does."""
    assert not isinstance(value, str)
    exact = isinstance(value, float) or abs(value) <= _EXACT
    return Numbers(np.array(value, np.float64 if exact else object))


def _floats(whole: NDArray[np.signedinteger]) -> NDArray[Any]:
    """Whole numbers as floats; if they are too large for that, as Python's own."""
    small = whole.dtype.itemsize <= 4 or not np.any((whole > _EXACT) | (whole < -_EXACT))
    return whole.astype(np.float64 if small else object)


def _counted(first: int, count: int) -> Numbers:
    """`first`, `first` + 1, ..."""
    if first + count <= _EXACT:
        return Numbers(np.arange(first, first + count, dtype=np.float64))
    return Numbers(np.arange(count).astype(object) + first)


def _present(column: Column) -> Mask:
    """In which rows a column has a value."""
    if isinstance(column, Numbers):
        return np.ones((), np.bool_) if column.present is None else column.present
    return np.array([word is not MISSING for word in column.words]).take(column.code)


def _held(left: Column, right: Column, sign: str) -> Mask:
    """In which rows two columns have values that compare so."""
    if isinstance(left, Numbers) and isinstance(right, Numbers):
        true = np.asarray(_UFUNCS[sign](left.value, right.value), np.bool_)
        for present in (left.present, right.present):
            if present is not None:
                true = true & present
        return true
    assert isinstance(left, Coded)
    assert isinstance(right, Coded)
    many = len(right.words)
    pair = left.code.astype(np.int64) * many + right.code
    asked: Iterable[int] = range(len(left.words) * many)
    if len(left.words) * many > _WHOLE_TABLE:
        distinct, place = np.unique(pair, return_inverse=True)
        asked, pair = distinct.tolist(), place.reshape(pair.shape)
    compare = COMPARISONS[sign]
    words = ((left.words[pair // many], right.words[pair % many]) for pair in asked)
    holds = [MISSING not in (one, other) and compare(one, other) for one, other in words]
    return np.array(holds, np.bool_).take(pair)
