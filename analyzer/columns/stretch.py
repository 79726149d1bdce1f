"""A stretch of regular traffic as columns, which give the same records as a Session does."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import chain, count, islice, repeat
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.decode import anomalies
from bilprov.analyzer.decode.decoder import unpaired_record
from bilprov.analyzer.decode.pairing import Held, Waiting
from bilprov.analyzer.decode.records import (
    DeviceRecord,
    HostRecord,
    LineRecord,
    Record,
)
from bilprov.captures.schemas import Line, State
from bilprov.spec.codec import Judgement
from bilprov.spec.motion import VARIABLES, is_moving
from bilprov.spec.protocol import Protocol
from bilprov.spec.steps import ShortFrames, Steps, short_frames
from bilprov.spec.tables import MOTIONS, FrameColumns, FrameTables, StateColumns, moving


class Span(NamedTuple):
    """Rows `start` to `stop` (not included) of one side, which follow each other.

    `side` says of which: the host's rows, the device's, or the line events. The first `after` host
    rows have taken effect then.
    """

    side: Literal["host", "device", "line"]
    start: int
    stop: int
    after: int


class Answer(NamedTuple):
    """One device row: its byte and time (ns), and the instruction it answers.

    That is its number, its bytes and when they ended (ns). `fits` tells whether the answer is the
    expected one and in time. Where nothing is paired the number is -1.
    """

    byte: int
    t: int
    sequence: int
    frame: bytes
    end: int
    fits: bool


Rows: TypeAlias = "slice | NDArray[np.int64]"
"""Some rows, in order."""


@dataclass(frozen=True)
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

    @property
    def short(self) -> ShortFrames:
        """The frames of at most one data byte, ready made."""
        return short_frames(self.protocol)


@dataclass(frozen=True)
class Stretch:
    """Regular traffic: every frame is whole, and every answer came while it was waited for.

    `data` are the host's bytes. Host rows are counted from 0; the first `carried` were handed out
    before and only wait for an answer, and row 0 has the number `sequence`. `frames` and `end` (ns,
    of the last byte) have all of them, `start` (ns, of the first byte) and `states` the new ones.
    Device row j (`byte`, `t` in ns) answers host row j, or none if nothing is paired. `before` is
    the state before the new rows and `last` that after them, `lines` are the line events, and
    `spans` tells the order.
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
    last: State
    lines: tuple[Line, ...]
    spans: Sequence[Span]

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
    def moving(self) -> NDArray[np.bool_]:
        """Whether the wheels turn after each new host row."""
        return self.decoding.tables.moving(self.data, self.new, values_of(self.before))

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
            return self.decoding.tables.used.take(self.byte)
        return self.agrees & (self.latency <= self.decoding.late) & (self.latency >= 0)

    @cached_property
    def earliest(self) -> int:
        """The earliest time (ns) of a record; of a frame its first byte's."""
        times = [line.t for line in self.lines[:1]]
        times += [int(t) for t in (*self.start[:1], *self.t[:1])]
        return min(times, default=0)

    @cached_property
    def latest(self) -> int:
        """The latest time (ns) of a record; of a frame its first byte's."""
        times = [line.t for line in self.lines[-1:]]
        times += [int(t) for t in (*self.start[-1:], *self.t[-1:])]
        return max(times, default=0)

    @property
    def rows(self) -> int:
        """How many records there are."""
        return len(self.start) + len(self.t) + len(self.lines)

    @cached_property
    def odd(self) -> NDArray[np.bool_]:
        """Whether each device row has an anomaly."""
        return ~self.fits

    def frame_counts(self) -> Iterator[tuple[int, int]]:
        """Yield the times (ns) at which frames were complete, and how many were."""
        times, counts = np.unique(self.end[self.carried :], return_counts=True)
        return zip(times.tolist(), counts.tolist(), strict=True)

    @property
    def after(self) -> int:
        """The number of host rows: those that wait, and the new ones."""
        return len(self.end)

    def state(self, after: int) -> State:
        """The state once the first `after` host rows have taken effect."""
        if after <= self.carried:
            return self.before
        if after == self.after:
            return self.last
        return written(*(int(column[after - self.carried - 1]) for column in self.states))

    def records(self) -> Iterator[Record]:
        """Yield the records in order, as a Session decodes them."""
        hosts = self.hosts(slice(self.carried, None))
        devices = self._devices()
        for side, start, stop, after in self.spans:
            if side == "host":
                yield from islice(hosts, stop - start)
            elif side == "device":
                yield from islice(devices, stop - start)
            else:
                yield self.line(start, after)

    def inside(
        self, first: int | None, after: int | None
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which new host rows and device rows are in `first <= t < after` (ns; None: no bound)."""
        host, device = (np.ones(len(t), np.bool_) for t in (self.start, self.t))
        for mask, t in ((host, self.start), (device, self.t)):
            if first is not None:
                mask &= t >= first
            if after is not None:
                mask &= t < after
        return host, device

    def chosen(
        self, host: NDArray[np.bool_], device: NDArray[np.bool_], lines: Sequence[bool]
    ) -> Iterator[Record]:
        """Yield the records of the new host rows, device rows and line events where it says so."""
        hosts = self.hosts(np.flatnonzero(host) + self.carried)
        answers = self.answers(np.flatnonzero(device))
        before = np.append(0, np.cumsum(host)).tolist()
        given = np.append(0, np.cumsum(device)).tolist()
        for side, start, stop, after in self.spans:
            if side == "host":
                start, stop = start - self.carried, stop - self.carried
                yield from islice(hosts, before[stop] - before[start])
            elif side == "device":
                state = self.state(after)
                for answer in islice(answers, given[stop] - given[start]):
                    yield self.device_record(answer, state)
            elif lines[start]:
                yield self.line(start, after)

    def frame_bytes(self, rows: Rows) -> list[bytes]:
        """The bytes of host rows."""
        short = self.decoding.short.frames
        frames: list[Any] = list(map(short.__getitem__, self.frames.key[rows].tolist()))
        for place, frame in self._long_frames(rows):
            frames[place] = frame
        return frames

    def judgements(self, rows: Rows) -> list[Judgement]:
        """The judgements of host rows."""
        short, steps = self.decoding.short.judgements, self.decoding.steps
        judged: list[Any] = list(map(short.__getitem__, self.frames.key[rows].tolist()))
        for place, frame in self._long_frames(rows):
            judged[place] = steps[frame].judgement
        return judged

    def _long_frames(self, rows: Rows) -> Iterator[tuple[int, bytes]]:
        """The frames of more than one data byte among host rows, each with its place there."""
        size, offset = self.size[rows], self.frames.offset[rows]
        places = np.flatnonzero(size > _SHORT)
        if not len(places):
            return iter(())
        start = offset.take(places)
        end, low = start + size.take(places), int(start[0])
        data = self.data[low : int(end[-1])].tobytes()
        slices = map(slice, (start - low).tolist(), (end - low).tolist())
        return zip(places.tolist(), map(data.__getitem__, slices), strict=True)

    def answers(self, rows: Rows) -> Iterator[Answer]:
        """Yield device rows one by one."""
        byte, t = self.byte[rows].tolist(), self.t[rows].tolist()
        if not self.decoding.paired:
            return map(Answer, byte, t, repeat(-1), repeat(b""), repeat(0), repeat(False))
        given = slice(len(self.t))
        sequence = (np.arange(self.sequence, self.sequence + len(self.t)))[rows].tolist()
        frames = self.frame_bytes(np.arange(len(self.t))[rows])
        end, fits = self.end[given][rows].tolist(), self.fits[rows].tolist()
        return map(Answer, byte, t, sequence, frames, end, fits)

    def line(self, place: int, after: int) -> LineRecord:
        """The record of a line event, after the first `after` host rows."""
        line = self.lines[place]
        return LineRecord(line, False, self.state(after), anomalies.of_line(line, lost=False))

    def device_record(self, answer: Answer, state: State) -> DeviceRecord:
        """The record of a device row."""
        byte, t, sequence, frame, end, fits = answer
        protocol = self.decoding.protocol
        if not self.decoding.paired:
            return unpaired_record(protocol, Held(t, byte), anomalies.ALONE, state)
        judgement = self.decoding.steps[frame].judgement
        if fits:
            return DeviceRecord(
                t, byte, judgement.response, judgement, sequence, t - end, True, state
            )
        return self._odd_answer(Waiting(sequence, end, end, judgement), Held(t, byte), state)

    def hosts(self, rows: Rows) -> Iterator[HostRecord]:
        """Yield the records of new host rows (of all host rows, counted from 0)."""
        rows = np.arange(self.after)[rows]
        new = rows - self.carried
        end = _objects(self.end[rows])
        motion, speed, steering, led = (column[new] for column in self.states)
        states = map(
            State,
            _NAMES[motion].tolist(),
            speed.tolist(),
            steering.tolist(),
            led.tolist(),
            moving(motion, speed).tolist(),
        )
        return map(
            HostRecord,
            _objects(self.start[new]),
            end,
            end,
            repeat("instruction"),
            self.frame_bytes(rows),
            self.judgements(rows),
            (rows + self.sequence).tolist(),
            states,
        )

    def _devices(self) -> Iterator[DeviceRecord]:
        """Yield the records of all device rows."""
        spans = [span for span in self.spans if span.side == "device"]
        states = (repeat(self.state(span.after), span.stop - span.start) for span in spans)
        state = chain.from_iterable(states)
        if not self.decoding.paired:
            return map(self.device_record, self.answers(slice(None)), state)
        byte = self.byte.tolist()
        usual = map(
            DeviceRecord,
            _objects(self.t),
            byte,
            map(self.decoding.protocol.codes.get, byte),
            self.judgements(slice(len(self.t))),
            count(self.sequence),
            _objects(self.latency),
            repeat(True),
            state,
        )
        return self._with_odd(usual) if self.odd.any() else usual

    def _with_odd(self, usual: Iterator[DeviceRecord]) -> Iterator[DeviceRecord]:
        """Yield device records, those with an anomaly as they should be."""
        odd = np.flatnonzero(self.odd)
        answers = self.answers(odd)
        at = 0
        for row in odd.tolist():
            yield from islice(usual, row - at)
            yield self.device_record(next(answers), next(usual).state)
            at = row + 1
        yield from usual

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


_SHORT = 2  # bytes of a frame that `ShortFrames` has
_NAMES = np.array([motion.value for motion in MOTIONS], object)
_moving = lru_cache(maxsize=4096)(is_moving)


def written(motion: int, speed: int, steering: int, led: int) -> State:
    """The state of a row of StateColumns, as it is written."""
    name = _NAMES[motion]
    return State(name, speed, steering, led, _moving(name, speed))


def _objects(values: NDArray[np.int64]) -> list[int]:
    """Numbers as a list, in which neighbours that are equal are one object."""
    if not len(values):
        return []
    first = np.flatnonzero(np.diff(values, prepend=values[0] - 1))
    runs = np.diff(first, append=len(values))
    listed: list[int] = np.repeat(values[first].astype(object), runs).tolist()
    return listed


def values_of(state: State) -> tuple[Any, ...]:
    """The values of VARIABLES in a state."""
    return tuple(getattr(state, variable) for variable in VARIABLES)
