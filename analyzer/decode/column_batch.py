"""Regular traffic in columns. Needs numpy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import repeat
from operator import attrgetter
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.decode import anomalies
from bilprov.analyzer.decode.batch import (
    INSTRUCTION,
    Batch,
    DeviceRows,
    HostRows,
    OtherRows,
    Selection,
    StateColumns,
    repeated,
    sliced,
)
from bilprov.analyzer.decode.pairing import Held, Waiting
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, LineRecord, Record
from bilprov.captures.schemas import Line
from bilprov.spec.arrays.layouts import Requests
from bilprov.spec.arrays.states import Known
from bilprov.spec.arrays.tables import Answers, AnswerTables, RequestTables
from bilprov.spec.codec import Judgement, Steps
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import Reply, read_as, usual_way
from bilprov.spec.state import State

_FEW = 256  # frames that are looked up one by one faster than they are compared


@dataclass(frozen=True)
class Decoding:
    """What decoding into columns rests on: the protocol, its tables, and the session's settings.

    `skew` and `late` (the answer's deadline) are in ns.
    """

    protocol: Protocol
    requests: RequestTables
    answers: AnswerTables
    steps: Steps
    skew: int
    late: int


@dataclass(frozen=True, eq=False)
class ColumnBatch(Batch):
    """Regular traffic as arrays: every frame is whole, every answer is to the request in turn.

    `data` are the host's bytes and `heard` the device's. The `requests` are the new frames, which
    came from `start` to `end` (ns); the first has the number `first`. Answer j of `answers`, whose
    first byte came at `t` (ns), is to the frame of row j of `asked`, which has the number
    `sequence` and ended at `asked_end` (ns); `after` counts the new frames before it. `before` is
    the state before the new frames. Before each of the `lines` come `line_after` new frames and
    `line_heard` answers.
    """

    decoding: Decoding
    data: NDArray[np.uint8]
    heard: NDArray[np.uint8]
    requests: Requests
    first: int
    start: NDArray[np.int64]
    end: NDArray[np.int64]
    asked: Requests
    asked_end: NDArray[np.int64]
    sequence: NDArray[np.int64]
    answers: Answers
    t: NDArray[np.int64]
    after: NDArray[np.int64]
    before: Known
    lines: Sequence[Line]
    line_after: NDArray[np.int64]
    line_heard: NDArray[np.int64]

    def __reduce__(self) -> tuple[Any, ...]:
        kept = [getattr(self, field.name) for field in fields(self)]
        return type(self), tuple(kept)  # without what is worked out from them

    def __len__(self) -> int:
        return len(self.start) + len(self.t) + len(self.lines)

    @cached_property
    def hosts(self) -> HostRows:
        """The host's rows."""
        count, alone, tables = len(self.start), self._alone, self.decoding.requests
        timelines = self._timelines
        return HostRows(
            t=self.start,
            end=self.end,
            known=self.end,
            kind=np.broadcast_to(np.uint8(INSTRUCTION), count),
            data=self.data,
            offset=self.requests.offset,
            size=self.requests.size,
            verdict=self.requests.verdict,
            sequence=self.first + np.arange(count),
            states=StateColumns(timelines.kind, count, lambda name: timelines[name][1:]),
            samples=alone._host_samples,
            header=tables.keys.take(self.requests.kind),
            due=tables.due(self.data, self.requests),
            uncertain=np.broadcast_to(np.False_, count),
        )

    @cached_property
    def devices(self) -> DeviceRows:
        """The device's rows."""
        alone, tables, answers = self._alone, self.decoding, self.answers
        verdict, timelines, after = self.asked.verdict, self._timelines, self.after
        right = tables.answers.agree(self.asked, answers)
        fields_at, fields_size = tables.answers.fields(self.asked.kind, answers)
        latency = self.t - self.asked_end
        late = latency > tables.late

        def sort(rows: NDArray[np.int64]) -> NDArray[np.int64]:
            """Rows with the same number have the same kinds of anomalies."""
            wrong: NDArray[np.int64] = 512 * verdict[rows].astype(np.int64) + answers.code[rows]
            return late[rows] * (1 << 18) + wrong

        return DeviceRows(
            t=self.t,
            byte=self._byte(slice(None)),
            sequence=self.sequence,
            header=tables.requests.keys.take(self.asked.kind),
            verdict=verdict,
            latency=latency,
            agrees=right.view(np.int8),
            odd=~right | late | (latency < 0),
            states=StateColumns(timelines.kind, len(after), lambda n: timelines[n].take(after)),
            samples=alone._samples,
            sort=sort,
            data=self.heard,
            offset=answers.offset,
            size=answers.size,
            name=answers.code,
            names=tables.answers.names,
            fields_at=fields_at,
            fields_size=fields_size,
            address=tables.answers.addresses(self.asked.kind, self.heard, answers),
        )

    @cached_property
    def others(self) -> OtherRows:
        """The other rows."""
        after = self.line_after
        states = self._timelines.states.take(after).tolist() if len(after) else []
        return OtherRows(
            [
                LineRecord(line, False, state, anomalies.of_line(line, lost=False))
                for line, state in zip(self.lines, states, strict=True)
            ]
        )

    @cached_property
    def places(self) -> tuple[NDArray[np.int64], ...]:
        """The numbers of the host's, the device's and the other rows among all rows in order."""
        hosts, devices = np.arange(len(self.start)), np.arange(len(self.t))
        before = _up_to(self.after, hosts) + _up_to(self.line_after, hosts)
        return (
            hosts + before,
            devices + self.after + _up_to(self.line_heard, devices),
            np.arange(len(self.lines)) + self.line_after + self.line_heard,
        )

    def _byte(self, rows: slice | NDArray[np.int64]) -> NDArray[np.integer]:
        """The codes of some of the answers."""
        code, tables = self.answers.code[rows], self.decoding
        return code if tables.protocol.plain else tables.answers.bytes.take(code)

    def records(self, chosen: Selection | None = None) -> Sequence[Record]:
        """The rows in order as records; the chosen ones, None for all."""
        hosts, devices, others = (
            np.arange(len(places)) if chosen is None else np.flatnonzero(mask)
            for places, mask in zip(self.places, chosen or self.places, strict=True)
        )
        states = self._timelines.states
        made: list[Record] = [*self._host_records(hosts, states.take(hosts + 1).tolist())]
        made += self._answers(devices, states.take(self.after[devices]).tolist())
        made += [self.others.listed[row] for row in others.tolist()]
        rows = zip(self.places, (hosts, devices, others), strict=True)
        order = np.argsort(np.concatenate([places[some] for places, some in rows]))
        records: list[Record] = np.fromiter(made, object, len(made))[order].tolist()
        return records

    @cached_property
    def _alone(self) -> Self:
        """The batch without its rows, for what they call.

        If they held the batch that holds them, all would stay in memory until the garbage collector
        runs, which it hardly ever does among arrays.
        """
        return copy(self)

    def _host_records(self, rows: NDArray[np.int64], states: list[State]) -> Iterator[HostRecord]:
        """The records of some of the host's rows, in these states."""
        end = objects(self.end[rows])
        judged = self._judgements(rows).tolist()
        return map(
            HostRecord,
            objects(self.start[rows]),
            end,
            end,
            repeat("instruction"),
            map(attrgetter("frame"), judged),
            judged,
            (self.first + rows).tolist(),
            states,
        )

    def _host_samples(self, rows: NDArray[np.int64]) -> list[HostRecord]:
        return [*self._host_records(rows, [self.before.state] * len(rows))]

    def _samples(self, rows: NDArray[np.int64]) -> list[DeviceRecord]:
        return self._answers(rows, [self.before.state] * len(rows))

    def _answers(self, rows: NDArray[np.int64], states: list[State]) -> list[DeviceRecord]:
        """The records of some of the device's rows, in these states."""
        tables, t, end = self.decoding, self.t[rows], self.asked_end[rows]
        asked, answers = self.asked.rows(rows), self.answers.rows(rows)
        odd = ~tables.answers.agree(asked, answers) | (t - end > tables.late) | (t < end)
        # The judgements of the frames that they answer.
        new = self.sequence[rows] - self.first
        carried = int(np.searchsorted(new, 0))
        before = self._judged(asked.rows(slice(carried)))
        judged = [*before.tolist(), *self._judgements(new[carried:]).tolist()]
        made = list(
            map(
                DeviceRecord,
                objects(t),
                self._byte(rows).tolist(),
                map(tables.answers.responses.__getitem__, answers.code.tolist()),
                judged,
                self.sequence[rows].tolist(),
                objects(t - end),
                repeat(True),
                states,
                repeat(()),
                repeat(None) if tables.protocol.plain else self._replies(rows, judged),
            )
        )
        for at in np.flatnonzero(odd).tolist():
            one = made[at]
            assert one.answered is not None
            assert one.instruction is not None
            waiting = Waiting(one.instruction, int(end[at]), int(end[at]), one.answered)
            held = Held(one.t, one.byte, one.reply)
            made[at] = anomalies.answer_record(
                tables.protocol, held, one.state, waiting, skew=tables.skew
            )
        return made

    def _replies(self, rows: NDArray[np.int64], judged: Sequence[Judgement]) -> Iterator[Reply]:
        """The answers of several bytes to these frames."""
        protocol = self.decoding.protocol
        frames = sliced(self.heard, self.answers.offset[rows], self.answers.end[rows])
        for frame, asked in zip(frames, judged, strict=True):
            yield read_as(protocol, usual_way(protocol, asked.instruction), frame, asked)

    def _judgements(self, rows: NDArray[np.int64]) -> NDArray[np.object_]:
        """The judgements of some of the new frames."""
        if 2 * len(rows) < len(self.start):
            return self._judged(self.requests.rows(rows))
        return self._all_judged.take(rows)

    @cached_property
    def _all_judged(self) -> NDArray[np.object_]:  # which the records of both sides have
        return self._judged(self.requests)

    def _judged(self, requests: Requests) -> NDArray[np.object_]:
        """The judgements of some frames; where frames are equal, one of them is looked up."""
        one, place = self._distinct(requests)
        frames = sliced(self.data, requests.offset[one], requests.end[one])
        steps = self.decoding.steps
        return np.fromiter((steps[frame].judgement for frame in frames), object, len(one))[place]

    def _distinct(self, requests: Requests) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """A row of each frame that differs from the others, and which of these each row equals.

        Frames of 8 bytes and more count as different, and so do a few.
        """
        rows = np.arange(len(requests.size))
        if len(rows) < _FEW:
            return rows, rows
        eight = self.data.take(requests.offset[:, None] + np.arange(8), mode="clip").view("<u8")
        bits = np.minimum(8 * requests.size, 64).astype(np.uint64)
        low = eight[:, 0] & ((np.uint64(1) << bits) - np.uint64(1))
        key = np.where(requests.size < 8, low, rows.astype(np.uint64)) | bits << np.uint64(56)
        _, one, place = np.unique(key, return_index=True, return_inverse=True)
        return one, place

    @cached_property
    def _timelines(self) -> StateColumns:
        """The variables before the new frames and after each."""
        tables, known = self.decoding.requests.states, (self.data, self.requests, self.before)
        count = len(self.start) + 1
        return StateColumns(type(self.before.state), count, lambda n: tables.column(n, *known))


def _up_to(values: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many of the values are at most the number of each row."""
    return np.bincount(values, minlength=len(rows))[: len(rows)].cumsum()


def objects(values: NDArray[np.int64]) -> list[int]:
    """Numbers as a list, in which neighbours that are equal are one object."""
    changed = np.ones(len(values), np.bool_)
    changed[1:] = values[1:] != values[:-1]
    listed: list[int] = repeated(values[changed].tolist(), changed).tolist()
    return listed
