"""Parts of a recording, packed to about a tenth of their size; each gives its rows as a page.

A stretch keeps its bytes and times; frames, verdicts and states are looked up again. Records are
compressed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import msgspec
import numpy as np
import zstandard
from bilprov.analyzer.columns.decoder import Part, Records
from bilprov.analyzer.columns.stretch import Decoding, Stretch
from numpy.typing import NDArray

from bilprov.analyzer.decode.records import (
    Anomaly,
    DeviceRecord,
    FaultRecord,
    HostRecord,
    LineRecord,
    Record,
    Severity,
)
from bilprov.analyzer.screen.pages import SIDES, Order, RecordsPage, StretchPage
from bilprov.captures.schemas import Line, State
from bilprov.spec.motion import is_moving
from bilprov.spec.protocol import Protocol
from bilprov.spec.steps import Steps

_LEVEL = 1  # of zstd


class Numbers(NamedTuple):
    """Numbers that hardly ever decrease: what is to be added to `base`, each for `runs` rows."""

    base: int
    more: NDArray[np.unsignedinteger]
    runs: NDArray[np.unsignedinteger] | None

    @classmethod
    def of(cls, values: NDArray[np.int64]) -> Numbers:
        """Pack numbers; neighbours that are equal become one where that takes less room."""
        if not len(values):
            return cls(0, np.empty(0, np.uint8), None)
        base = int(values.min())
        more = (values - base).astype(np.min_scalar_type(int(values.max()) - base))
        first = np.flatnonzero(np.diff(values, prepend=values[0] - 1))
        if 2 * len(first) > len(values):
            return cls(base, more, None)
        return cls(base, more[first], _small(np.diff(first, append=len(values))))

    def unpacked(self) -> NDArray[np.int64]:
        """The numbers."""
        values = self.more.astype(np.int64)
        values += self.base
        return values if self.runs is None else np.repeat(values, self.runs)

    @property
    def nbytes(self) -> int:
        """How much memory they take, in bytes."""
        return self.more.nbytes + (0 if self.runs is None else self.runs.nbytes)


@dataclass(frozen=True, slots=True)
class PackedStretch:
    """A Stretch without what can be worked out again.

    `sides` and `counts` have the sides and the numbers of rows of its spans.
    """

    decoding: Decoding
    data: bytes
    sizes: NDArray[np.unsignedinteger]
    carried: int
    sequence: int
    start: Numbers
    end: Numbers
    byte: bytes
    t: Numbers
    before: State
    last: State
    lines: tuple[Line, ...]
    sides: bytes
    counts: NDArray[np.unsignedinteger]

    @classmethod
    def of(cls, stretch: Stretch) -> PackedStretch:
        """Pack a stretch."""
        offset, size = stretch.frames.offset, stretch.size
        low, high = (int(offset[0]), int(offset[-1] + size[-1])) if len(offset) else (0, 0)
        counts = np.array([span.stop - span.start for span in stretch.spans], np.int64)
        return cls(
            decoding=stretch.decoding,
            data=stretch.data[low:high].tobytes(),
            sizes=_small(size),
            carried=stretch.carried,
            sequence=stretch.sequence,
            start=Numbers.of(stretch.start),
            end=Numbers.of(stretch.end),
            byte=stretch.byte.tobytes(),
            t=Numbers.of(stretch.t),
            before=stretch.before,
            last=stretch.last,
            lines=stretch.lines,
            sides=bytes(SIDES.index(span.side) for span in stretch.spans),
            counts=_small(counts),
        )

    @property
    def order(self) -> Order:
        """The spans of the stretch."""
        return Order(self.sides, self.counts, self.carried)

    def page(self, protocol: Protocol) -> StretchPage:
        """The rows of the stretch."""
        data, order = np.frombuffer(self.data, np.uint8), self.order
        offset = np.cumsum(self.sizes, dtype=np.int64) - self.sizes
        stretch = Stretch(
            decoding=self.decoding,
            data=data,
            frames=self.decoding.tables.frames(data, offset),
            carried=self.carried,
            sequence=self.sequence,
            start=self.start.unpacked(),
            end=self.end.unpacked(),
            byte=np.frombuffer(self.byte, np.uint8),
            t=self.t.unpacked(),
            before=self.before,
            last=self.last,
            lines=self.lines,
            spans=order,
        )
        return StretchPage(stretch, order)

    @property
    def nbytes(self) -> int:
        """How much memory it takes, in bytes, lines and objects left out."""
        arrays = self.sizes.nbytes + self.counts.nbytes + len(self.data) + len(self.byte)
        times = self.start.nbytes + self.end.nbytes + self.t.nbytes
        return arrays + times + len(self.sides)


@dataclass(frozen=True, slots=True)
class PackedRecords:
    """Records as compressed MessagePack."""

    packed: bytes

    @classmethod
    def of(cls, records: Records) -> PackedRecords:
        """Pack records. Raises OverflowError for times that only a forged file has."""
        rows = [_ROWS[type(record)](record) for record in records.listed]
        compress = zstandard.ZstdCompressor(_LEVEL).compress
        return cls(compress(msgspec.msgpack.encode(rows)))

    def page(self, protocol: Protocol) -> RecordsPage:
        """The rows of the records."""
        rows = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(self.packed))
        steps = Steps(protocol)
        return RecordsPage([_MAKERS[kind](protocol, steps, *values) for kind, *values in rows])

    @property
    def nbytes(self) -> int:
        """How much memory they take, in bytes."""
        return len(self.packed)


Packed: TypeAlias = PackedStretch | PackedRecords | RecordsPage
"""A part as it is kept, which gives its `page`."""


def packed(part: Part) -> Packed:
    """Pack a part."""
    if isinstance(part, Stretch):
        return PackedStretch.of(part)
    try:
        return PackedRecords.of(part)
    except OverflowError:
        return RecordsPage(part.listed)


def _small(values: NDArray[Any]) -> NDArray[np.unsignedinteger]:
    """Numbers from 0 up in as few bytes as they need."""
    most = int(values.max()) if len(values) else 0
    return values.astype(np.min_scalar_type(most))


def _host_row(r: HostRecord) -> tuple[Any, ...]:
    return 0, r.t, r.end, r.known, r.kind, r.data, r.sequence, _state_row(r.state), r.note


def _host(
    protocol: Protocol,
    steps: Steps,
    t: int,
    end: int,
    known: int,
    kind: Any,
    data: bytes,
    sequence: int | None,
    state: list[Any],
    note: str,
) -> Record:
    judgement = None if sequence is None else steps[data].judgement
    return HostRecord(t, end, known, kind, data, judgement, sequence, _state(state), note)


def _device_row(r: DeviceRecord) -> tuple[Any, ...]:
    frame = r.answered.frame if r.answered else None
    state, faults = _state_row(r.state), _fault_rows(r)
    return 1, r.t, r.byte, frame, r.instruction, r.latency, r.agrees, state, faults


def _device(
    protocol: Protocol,
    steps: Steps,
    t: int,
    byte: int,
    frame: bytes | None,
    instruction: int | None,
    latency: int | None,
    agrees: bool | None,
    state: list[Any],
    faults: list[Any],
) -> Record:
    answered = None if frame is None else steps[frame].judgement
    answer = protocol.codes.get(byte)
    return DeviceRecord(
        t, byte, answer, answered, instruction, latency, agrees, _state(state), _faults(faults)
    )


def _line_row(r: LineRecord) -> tuple[Any, ...]:
    return 2, msgspec.structs.astuple(r.value), r.lost, _state_row(r.state), _fault_rows(r)


def _line(
    protocol: Protocol, steps: Steps, line: list[Any], lost: bool, state: Any, faults: Any
) -> Record:
    return LineRecord(Line(*line), lost, _state(state), _faults(faults))


def _fault_row(r: FaultRecord) -> tuple[Any, ...]:
    return 3, _fault_rows(r), _state_row(r.state)


def _fault(protocol: Protocol, steps: Steps, faults: list[Any], state: list[Any]) -> Record:
    (anomaly,) = _faults(faults)
    return FaultRecord(anomaly, _state(state))


_ROWS: dict[type[Record], Any] = {
    HostRecord: _host_row,
    DeviceRecord: _device_row,
    LineRecord: _line_row,
    FaultRecord: _fault_row,
}
_MAKERS = (_host, _device, _line, _fault)


def _state_row(state: State) -> tuple[Any, ...]:
    return state.motion, state.speed, state.steering, state.led


def _state(row: list[Any]) -> State:
    motion, speed, steering, led = row
    return State(motion, speed, steering, led, is_moving(motion, speed))


def _fault_rows(record: Record) -> list[tuple[Any, ...]]:
    return [(f.t, f.kind, int(f.severity), f.reason, f.instruction) for f in record.faults]


def _faults(rows: list[Any]) -> tuple[Anomaly, ...]:
    return tuple(Anomaly(t, kind, Severity(s), why, about) for t, kind, s, why, about in rows)
