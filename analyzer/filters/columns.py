"""The values that a filter asks for, as columns of the rows of a Stretch. Needs numpy.

Numbers and bytes are arrays; words are coded, so that each word of a column is looked at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from bilprov.analyzer.columns.kinds import device_kinds, host_kinds
from bilprov.analyzer.columns.stretch import Stretch
from numpy.typing import NDArray

from bilprov.analyzer.decode.records import DeviceRecord
from bilprov.analyzer.filters.moments import DAY, STEP, offset
from bilprov.analyzer.filters.tree import DATE, TIME_OF_DAY
from bilprov.spec.steps import data_decide
from bilprov.spec.tables import MOTIONS, VALID, moving

Mask: TypeAlias = NDArray[np.bool_]


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

_NONE = Numbers(np.zeros((), np.int64), np.zeros((), np.bool_))


class Rows(ABC):
    """The rows of one side of a stretch."""

    def __init__(self, stretch: Stretch, start: int | None, count: int) -> None:
        self._stretch = stretch
        self._start = start
        self.count = count
        self._protocol = stretch.decoding.protocol
        self._columns: dict[str, Column] = {}

    def column(self, key: str) -> Column:
        """The values of a name."""
        found = self._columns.get(key)
        if found is None:
            found = self._columns[key] = self._made(key)
        return found

    def _made(self, key: str) -> Column:
        space, _, name = key.rpartition(".")
        if space == "fields":
            return self._field(name)
        if space == "state":
            return self._state(name)
        if key in (DATE, TIME_OF_DAY):
            return self._clock(key)
        made: Column = getattr(self, f"_{key}")()
        return made

    def _clock(self, key: str) -> Numbers:
        """The wall clock in ns: since 1970, or since local midnight."""
        if self._start is None:
            return _NONE
        wall = np.rint(np.multiply(self._t().value, 1e9)).astype(np.int64) + self._start
        if key == DATE:
            return Numbers(wall)
        step = wall // STEP
        begins = np.flatnonzero(np.diff(step, prepend=step[0] - 1))  # a run of one offset each
        offsets = [offset(one) for one in step[begins].tolist()]
        runs = np.diff(begins, append=len(step))
        return Numbers((wall + np.repeat(np.array(offsets, np.int64), runs)) % DAY)

    @abstractmethod
    def _t(self) -> Numbers:
        """Seconds since the start."""

    @abstractmethod
    def _field(self, name: str) -> Numbers:
        """A field of the instructions."""

    @abstractmethod
    def _state(self, variable: str) -> Column:
        """A variable of the state, or `moving`."""


class HostRows(Rows):
    """The new host rows."""

    def __init__(self, stretch: Stretch, start: int | None) -> None:
        super().__init__(stretch, start, stretch.host_rows)

    @cached_property
    def _header(self) -> NDArray[np.uint8]:
        return (self._stretch.new.key >> 8).astype(np.uint8)

    def _field(self, name: str) -> Numbers:
        stretch, protocol = self._stretch, self._protocol
        value = np.zeros(self.count, np.int64)
        present = np.zeros(self.count, np.bool_)
        for spec in protocol.instructions:
            for part in spec.fields:
                if part.name == name:
                    header = protocol.header_bytes[spec.id, spec.length]
                    rows = np.flatnonzero(self._header == header)
                    offsets = stretch.new.offset[rows]
                    value[rows] = stretch.decoding.tables.field(part, stretch.data, offsets)
                    present[rows] = True
        return Numbers(value, present)

    def _state(self, variable: str) -> Column:
        states = self._stretch.states
        if variable == "moving":
            return Words(moving(states.motion, states.speed).view(np.uint8), (False, True))
        column = getattr(states, variable)
        return _motion_words(column) if variable == "motion" else Numbers(column)

    def _id(self) -> Numbers:
        ids = np.array([identity for identity, _ in self._protocol.headers])
        return Numbers(ids.take(self._header))

    def _len(self) -> Numbers:
        return Numbers(np.array(list(self._protocol.lengths)).take(self._header))

    def _hex(self) -> Octets:
        stretch = self._stretch
        return Octets(stretch.data, stretch.new.offset, stretch.size[stretch.carried :])

    def _data(self) -> Octets:
        data, start, size = self._hex()
        return Octets(data, start + 1, size - 1)

    def _direction(self) -> Words:
        return _one("host")

    def _kind(self) -> Words:
        return _one("instruction")

    def _name(self) -> Words:
        known = self._protocol.by_id
        specs = [known.get(identity) for identity, _ in self._protocol.headers]
        return Words(self._header, [spec.name if spec else None for spec in specs])

    def _judgement(self) -> Numbers:
        return Numbers(self._stretch.decoding.tables.codes.take(self._stretch.new.verdict))

    def _faulty(self) -> Words:
        faulty = np.not_equal(self._stretch.new.verdict, VALID)
        return Words(faulty.view(np.uint8), (False, True))

    def _faults(self) -> Words:
        code, kinds = host_kinds(self._stretch)
        return Words(code, list(map(frozenset, kinds)))

    def _reason(self) -> Words:
        """The reasons; frames of one header and first byte have one, unless they are longer."""
        stretch, steps = self._stretch, self._stretch.decoding.steps
        decides = np.array([self._data_decide(header) for header in range(256)]).take(self._header)
        size = stretch.size[stretch.carried :]
        # Frames are of one sort that have the header and, if data decide, the first byte in common.
        key = np.where(decides & (size > 1), stretch.new.key, stretch.new.key & 0xFF00)
        sorts = np.flatnonzero(np.bincount(key, minlength=1 << 16))
        places: dict[str, int] = {}

        def place(frame: bytes) -> int:
            return places.setdefault(steps[frame].judgement.reason, len(places))

        code = np.zeros(1 << 16, np.int64)
        code[sorts] = [place(self._frame(sort)) for sort in sorts.tolist()]
        code = code.take(key)
        long = np.flatnonzero(decides & (size > 2))
        code[long] = [place(frame) for frame in stretch.frame_bytes(long + stretch.carried)]
        return Words(code, list(places))

    def _data_decide(self, header: int) -> bool:
        """Whether a frame's outcome depends on more than its header."""
        frame = bytes([header]) + bytes(self._protocol.lengths[header])
        return data_decide(self._protocol, frame)

    def _frame(self, key: int) -> bytes:
        """A frame of that header and first byte, else of zeros."""
        length = self._protocol.lengths[key >> 8]
        return key.to_bytes(2, "big").ljust(1 + length, b"\0")[: 1 + length]

    def _t(self) -> Numbers:
        return Numbers(self._stretch.start / 1e9)

    def _sequence(self) -> Numbers:
        return _counted(self._stretch.sequence + self._stretch.carried, self.count)

    def _none(self) -> Numbers:
        return _NONE

    _latency = _answers = _response = _none

    def _agrees(self) -> Words:
        return _one(None)


class DeviceRows(Rows):
    """The device rows."""

    def __init__(self, stretch: Stretch, start: int | None) -> None:
        super().__init__(stretch, start, len(stretch.byte))
        self._paired = stretch.decoding.paired

    @cached_property
    def _odd(self) -> tuple[NDArray[np.int64], list[DeviceRecord]]:
        """The rows with an anomaly, and a record of each (with a state that may be another)."""
        stretch = self._stretch
        rows = np.flatnonzero(~stretch.fits)
        return rows, [
            stretch.device_record(answer, stretch.before) for answer in stretch.answers(rows)
        ]

    def _of_odd(self, usual: Any, get: Callable[[DeviceRecord], Any]) -> Words:
        """What only rows with an anomaly have otherwise than `usual`."""
        rows, records = self._odd
        words = {usual: 0}
        code = np.zeros(self.count, np.int64)
        code[rows] = [words.setdefault(get(record), len(words)) for record in records]
        return Words(code, list(words))

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
            assert isinstance(motion, Words)
            assert isinstance(speed, Numbers)
            return Words(moving(motion.code, np.asarray(speed.value)).view(np.uint8), (False, True))
        column: NDArray[Any] = getattr(self._stretch.states, variable)
        first = getattr(before, variable)
        if variable == "motion":
            first = MOTIONS.index(first)
        values = np.concatenate([np.array([first], column.dtype), column]).take(self._after)
        return _motion_words(values) if variable == "motion" else Numbers(values)

    def _none(self) -> Numbers:
        return _NONE

    _id = _len = _sequence = _none

    def _data(self) -> Octets:
        none = np.full(self.count, -1)
        return Octets(self._stretch.byte, np.zeros(self.count, np.int64), none)

    def _hex(self) -> Octets:
        return Octets(self._stretch.byte, np.arange(self.count), np.ones(self.count, np.int64))

    def _direction(self) -> Words:
        return _one("device")

    def _kind(self) -> Words:
        return _one("response")

    def _name(self) -> Words:
        codes = [self._protocol.codes.get(byte) for byte in range(256)]
        return Words(self._stretch.byte, [code.name if code else None for code in codes])

    def _response(self) -> Numbers:
        return Numbers(self._stretch.byte)

    @property
    def _verdict(self) -> NDArray[np.uint8]:
        """The verdict of the instruction that each row answers; for paired rows only."""
        return self._stretch.frames.verdict[: self.count]

    def _judgement(self) -> Numbers:
        if not self._paired:
            return _NONE
        return Numbers(self._stretch.decoding.tables.codes.take(self._verdict))

    def _faulty(self) -> Words:
        code, kinds = device_kinds(self._stretch)
        faulty = np.array([bool(one) for one in kinds]).take(code)
        if self._paired:
            faulty |= self._verdict != VALID
        return Words(faulty.view(np.uint8), (False, True))

    def _faults(self) -> Words:
        code, kinds = device_kinds(self._stretch)
        return Words(code, list(map(frozenset, kinds)))

    def _reason(self) -> Words:
        return self._of_odd("", lambda record: record.reason)

    def _t(self) -> Numbers:
        return Numbers(self._stretch.t / 1e9)

    def _answers(self) -> Numbers:
        return _counted(self._stretch.sequence, self.count) if self._paired else _NONE

    def _latency(self) -> Numbers:
        return Numbers(self._stretch.latency / 1e9) if self._paired else _NONE

    def _agrees(self) -> Words:
        if self._paired:
            return Words(self._stretch.agrees.view(np.uint8), (False, True))
        return self._of_odd(None, lambda record: record.agrees)


def _motion_words(code: NDArray[np.integer]) -> Words:
    return Words(code, [motion.value for motion in MOTIONS])


def _one(word: str | None) -> Words:
    return Words(np.zeros((), np.int64), (word,))


def _counted(first: int, count: int) -> Numbers:
    """`first`, `first` + 1, ..."""
    return Numbers(np.arange(first, first + count))
