"""A stretch of regular traffic as columns, which give the same records as a Session does."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.decode import anomalies
from bilprov.analyzer.decode.decoder import unpaired_record
from bilprov.analyzer.decode.pairing import Held, Waiting
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, LineRecord, Record
from bilprov.captures.schemas import Line, State
from bilprov.spec.motion import VARIABLES, is_moving
from bilprov.spec.protocol import Protocol
from bilprov.spec.steps import Steps
from bilprov.spec.tables import MOTIONS, FrameColumns, FrameTables, StateColumns


class Span(NamedTuple):
    """Rows `start` to `stop` (not included) of one side, which follow each other.

    `side` says of which: the host's rows, the device's, or the line events. The first `after` host
    rows have taken effect then.
    """

    side: Literal["host", "device", "line"]
    start: int
    stop: int
    after: int


@dataclass(frozen=True, slots=True)
class Decoding:
    """What decoding into columns rests on: the protocol, its tables, and the session's settings.

    `paired` is true if both directions are heard; `skew` and `late` (the answer's deadline) are in
    ns.
    """

    protocol: Protocol
    tables: FrameTables
    steps: Steps
    paired: bool
    skew: int
    late: int


@dataclass(frozen=True)
class Stretch:
    """Regular traffic: every frame is whole, and every answer came while it was waited for.

    `data` are the host's bytes. Host rows are counted from 0; the first `carried` were handed out
    before and only wait for an answer, and row 0 has the number `sequence`. `frames` and `end` (ns,
    of the last byte) have all of them, `start` (ns, of the first byte) and `states` the new ones.
    Device row j (`byte`, `t` in ns) answers host row j, or none if nothing is paired. `before` is
    the state before the new rows, `lines` are the line events, and `spans` tells the order.
    """

    decoding: Decoding
    data: NDArray[np.uint8]
    frames: FrameColumns
    carried: int
    sequence: int
    start: NDArray[np.int64]
    end: NDArray[np.int64]
    byte: NDArray[np.uint8]
    t: NDArray[np.int64]
    before: State
    lines: tuple[Line, ...]
    spans: tuple[Span, ...]

    @property
    def host_rows(self) -> int:
        """How many new host rows there are."""
        return len(self.start)

    @cached_property
    def size(self) -> NDArray[np.int64]:
        """The length of each host row in bytes, its header included."""
        return self.decoding.tables.sizes.take(self.frames.key >> 8)

    @cached_property
    def new(self) -> FrameColumns:
        """The frames of the new host rows."""
        return self.frames.rows(slice(self.carried, None))

    @cached_property
    def states(self) -> StateColumns:
        """The predicted state after each new host row."""
        return self.decoding.tables.states(self.data, self.new, values_of(self.before))

    @cached_property
    def agrees(self) -> NDArray[np.bool_]:
        """Whether each device row is the expected answer; for paired rows only."""
        expected = self.decoding.tables.codes.take(self.frames.verdict[: len(self.byte)])
        return np.equal(self.byte, expected)

    @cached_property
    def latency(self) -> NDArray[np.int64]:
        """The time (ns) from the instruction's last byte to its answer; for paired rows only."""
        return self.t - self.end[: len(self.t)]

    @cached_property
    def fits(self) -> NDArray[np.bool_]:
        """Which device rows have no anomaly: expected and in time, or if unpaired a known code."""
        if not self.decoding.paired:
            return np.isin(self.byte, list(self.decoding.protocol.codes))
        return self.agrees & (self.latency <= self.decoding.late)

    def frame(self, row: int) -> bytes:
        """The bytes of a host row."""
        at = int(self.frames.offset[row])
        return self.data[at : at + int(self.size[row])].tobytes()

    def state(self, after: int) -> State:
        """The state once the first `after` host rows have taken effect."""
        if after <= self.carried:
            return self.before
        return written(*(int(column[after - self.carried - 1]) for column in self.states))

    def records(self) -> Iterator[Record]:
        """Yield the records in order, as a Session decodes them."""
        for side, start, stop, after in self.spans:
            if side == "host":
                yield from self.host_records(start, stop)
            elif side == "device":
                yield from self.device_records(start, stop, after)
            else:
                yield from self.line_records(start, stop, after)

    def line_records(self, start: int, stop: int, after: int) -> Iterator[LineRecord]:
        """Yield the records of line events, after the first `after` host rows."""
        for line in self.lines[start:stop]:
            found = anomalies.of_line(line, lost=False)
            yield LineRecord(line, False, self.state(after), found)

    def frame_bytes(self, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes of host rows, which must be one or more."""
        offset, size = self.frames.offset[start:stop], self.size[start:stop]
        low, high = int(offset[0]), int(offset[-1] + size[-1])
        data = self.data[low:high].tobytes()
        offset = offset - low
        return (
            data[at:end] for at, end in zip(offset.tolist(), (offset + size).tolist(), strict=True)
        )

    def host_records(self, start: int, stop: int) -> Iterator[HostRecord]:
        """Yield the records of new host rows."""
        steps, new = self.decoding.steps, slice(start - self.carried, stop - self.carried)
        last: list[int] = []
        state = self.before
        for sequence, frame, begun, ended, *values in zip(
            count(self.sequence + start),
            self.frame_bytes(start, stop),
            self.start[new].tolist(),
            self.end[start:stop].tolist(),
            *(column[new].tolist() for column in self.states),
            strict=False,
        ):
            if values != last:
                last = values
                state = written(*values)
            judgement = steps[frame].judgement
            yield HostRecord(begun, ended, ended, "instruction", frame, judgement, sequence, state)

    def device_records(self, start: int, stop: int, after: int) -> Iterator[DeviceRecord]:
        """Yield the records of device rows, after the first `after` host rows."""
        state, protocol = self.state(after), self.decoding.protocol
        if not self.decoding.paired:
            for byte, t in zip(
                self.byte[start:stop].tolist(), self.t[start:stop].tolist(), strict=True
            ):
                yield unpaired_record(protocol, Held(t, byte), anomalies.ALONE, state)
            return
        for sequence, frame, byte, t, end, fits in zip(
            count(self.sequence + start),
            self.frame_bytes(start, stop),
            self.byte[start:stop].tolist(),
            self.t[start:stop].tolist(),
            self.end[start:stop].tolist(),
            self.fits[start:stop].tolist(),
            strict=False,
        ):
            judgement = self.decoding.steps[frame].judgement
            if fits:
                yield DeviceRecord(
                    t, byte, judgement.response, judgement, sequence, t - end, True, state
                )
            else:
                yield self._odd_answer(Waiting(sequence, end, end, judgement), Held(t, byte), state)

    def _odd_answer(self, waiting: Waiting, held: Held, state: State) -> DeviceRecord:
        """The record of an answer that is not the expected one, or that is late."""
        protocol = self.decoding.protocol
        verdict = anomalies.of_answer(protocol, held, waiting, self.decoding.skew)
        return DeviceRecord(
            held.t,
            held.byte,
            protocol.codes.get(held.byte),
            waiting.judgement,
            waiting.sequence,
            held.t - waiting.end,
            verdict.agrees,
            state,
            verdict.faults,
        )


def written(motion: int, speed: int, steering: int, led: int) -> State:
    """The state of a row of StateColumns, as it is written."""
    name = MOTIONS[motion].value
    return State(name, speed, steering, led, is_moving(name, speed))


def values_of(state: State) -> tuple[Any, ...]:
    """The values of VARIABLES in a state."""
    return tuple(getattr(state, variable) for variable in VARIABLES)
