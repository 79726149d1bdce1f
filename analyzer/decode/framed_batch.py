"""Regular traffic of frames of any layout, in columns. Needs numpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.decode.batch import (
    INSTRUCTION,
    DeviceRows,
    HostRows,
    StateColumns,
    WideAnswers,
    sliced,
)
from bilprov.analyzer.decode.column_batch import ColumnBatch
from bilprov.analyzer.decode.decoder import paired_record
from bilprov.analyzer.decode.pairing import Held, Waiting
from bilprov.analyzer.decode.records import DeviceRecord
from bilprov.spec.arrays.answers import NO_CODE, Answers, AnswerTables
from bilprov.spec.arrays.requests import Requests, RequestTables
from bilprov.spec.codec import Judgement
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import read_reply
from bilprov.spec.state import State
from bilprov.spec.steps import Steps
from bilprov.spec.tables import VALID


@dataclass(frozen=True)
class FramedDecoding:
    """What decoding rests on: the protocol, its tables, and the session's settings (ns)."""

    protocol: Protocol
    requests: RequestTables
    answers: AnswerTables
    steps: Steps
    skew: int
    late: int


@dataclass(frozen=True, eq=False)
class FramedBatch(ColumnBatch):
    """Regular traffic: every frame is whole and valid, and every answer is right and in turn.

    `data` are the host's bytes and `heard` the device's. The `requests` are the new frames, which
    came from `start` to `end` (ns); the first has the number `first`. Answer j of `answers`, whose
    first byte came at `t` (ns), is to the frame of row j of `asked`, which has the number
    `sequence` and ended at `asked_end` (ns); `device_after` new frames come before it. `before` is
    the state before the new frames and `new_states` those after each of them, None if they are the
    same. Before each of the `lines` come `line_after` new frames and
    `line_heard` answers.
    """

    decoding: FramedDecoding
    data: NDArray[np.uint8]
    heard: NDArray[np.uint8]
    requests: Requests
    first: int
    end: NDArray[np.int64]
    asked: Requests
    asked_end: NDArray[np.int64]
    sequence: NDArray[np.int64]
    answers: Answers
    new_states: Sequence[State] | None

    @cached_property
    def hosts(self) -> HostRows:
        """The host's rows."""
        count, alone = len(self.start), self._alone
        return HostRows(
            t=self.start,
            end=self.end,
            known=self.end,
            kind=np.broadcast_to(np.uint8(INSTRUCTION), count),
            data=self.data,
            offset=self.requests.offset,
            size=self.requests.size,
            verdict=np.broadcast_to(np.uint8(VALID), count),
            sequence=self.first + np.arange(count),
            states=StateColumns(type(self.before), count, alone._host_states),
            reasons=lambda rows: [""] * len(rows),
            keys=self.decoding.requests.keys.take(self.requests.kind),
            due=self.requests.due,
        )

    @cached_property
    def devices(self) -> DeviceRows:
        """The device's rows."""
        count, alone = len(self.t), self._alone
        latency = self.t - self.asked_end
        late = latency > self.decoding.late
        code = np.where(self.answers.code < 0, NO_CODE, self.answers.code)
        return DeviceRows(
            t=self.t,
            byte=self.decoding.answers.bytes.take(code),
            sequence=self.sequence,
            header=self.decoding.requests.keys.take(self.asked.kind),
            verdict=np.broadcast_to(np.uint8(VALID), count),
            latency=latency,
            agrees=np.broadcast_to(np.int8(1), count),
            odd=late | (latency < 0),
            states=StateColumns(type(self.before), count, alone._device_states),
            samples=alone._samples,
            sort=lambda rows: late[rows].astype(np.int64),
            wide=self._wide,
        )

    @property
    def _wide(self) -> WideAnswers:
        answers, tables = self.answers, self.decoding.answers
        fields_at, fields_size = tables.fields(self.asked.kind, answers)
        return WideAnswers(
            data=self.heard,
            offset=answers.offset,
            size=answers.size,
            name=np.where(answers.code < 0, NO_CODE, answers.code),
            names=tables.names,
            fields_at=fields_at,
            fields_size=fields_size,
            address=tables.addresses(self.asked.kind, self.heard, answers),
        )

    def _host_judgements(self, rows: NDArray[np.int64]) -> Sequence[Judgement]:
        return self._judged(self.requests.rows(rows))

    def _judged(self, requests: Requests) -> list[Judgement]:
        steps = self.decoding.steps
        return [
            steps[frame].judgement for frame in sliced(self.data, requests.offset, requests.end)
        ]

    def _answers(self, rows: NDArray[np.int64], states: list[State]) -> list[DeviceRecord]:
        """The records of some of the device's rows, in these states."""
        frames = sliced(self.heard, self.answers.offset[rows], self.answers.end[rows])
        columns = (self.t[rows], self.asked_end[rows], self.sequence[rows])
        times = (column.tolist() for column in columns)
        judged = self._judged(self.asked.rows(rows))
        return [self._answer(*one) for one in zip(*times, frames, judged, states, strict=True)]

    def _answer(
        self, t: int, end: int, sequence: int, frame: bytes, judgement: Judgement, state: State
    ) -> DeviceRecord:
        decoding = self.decoding
        held = Held.of_reply(t, read_reply(decoding.protocol, frame, judgement))
        waiting = Waiting(sequence, end, end, judgement)
        return paired_record(decoding.protocol, held, waiting, decoding.skew, state)

    def _host_states(self, variable: str) -> NDArray[Any]:
        return self._column(variable, self._states[1:])

    def _device_states(self, variable: str) -> NDArray[Any]:
        return self._column(variable, self._states.take(self.after))

    def _column(self, variable: str, states: NDArray[np.object_]) -> NDArray[Any]:
        """A variable in some states."""
        if self.new_states is None:
            value = self.before.code(variable, getattr(self.before, variable))
            return np.full(len(states), value)
        values = [one.code(variable, getattr(one, variable)) for one in states.tolist()]
        return np.array(values, np.int64)

    @cached_property
    def _states(self) -> NDArray[np.object_]:
        """The state before the new frames, and after each of them."""
        new = [self.before] * len(self.start) if self.new_states is None else self.new_states
        return np.fromiter([self.before, *new], object, 1 + len(new))
