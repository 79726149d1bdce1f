"""What batches of regular traffic have in common, whatever the layout of frames is. Needs numpy."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import repeat
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.decode import anomalies
from bilprov.analyzer.decode.batch import Batch, OtherRows, Selection, repeated
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, LineRecord, Record
from bilprov.captures.schemas import Line
from bilprov.spec.codec import Judgement
from bilprov.spec.state import State


@dataclass(frozen=True, eq=False)
class ColumnBatch(Batch):
    """Regular traffic as arrays; a subclass says how its frames are laid out.

    `start` (ns) is when the first byte of each new frame came, `t` (ns) that of each answer;
    `device_after` new frames come before it. `before` is the state before the new frames. Before
    each of the `lines` come `line_after` new frames and `line_heard` answers.
    """

    start: NDArray[np.int64]
    t: NDArray[np.int64]
    device_after: NDArray[np.int64]
    before: State
    lines: Sequence[Line]
    line_after: NDArray[np.int64]
    line_heard: NDArray[np.int64]

    def __reduce__(self) -> tuple[Any, ...]:
        kept = [getattr(self, field.name) for field in fields(self)]
        return type(self), tuple(kept)  # without what is worked out from them

    def __len__(self) -> int:
        return len(self.start) + len(self.t) + len(self.lines)

    @abstractmethod
    def _host_judgements(self, rows: NDArray[np.int64]) -> Sequence[Judgement]:
        """The judgements of some of the new frames."""

    @abstractmethod
    def _answers(self, rows: NDArray[np.int64], states: list[State]) -> list[DeviceRecord]:
        """The records of some of the device's rows, in these states."""

    @property
    @abstractmethod
    def _states(self) -> NDArray[np.object_]:
        """The state before the new frames, and after each of them."""

    @cached_property
    def others(self) -> OtherRows:
        """The other rows."""
        after = self.line_after
        states = self._states_after(after) if len(after) else []
        listed = [
            LineRecord(line, False, state, anomalies.of_line(line, lost=False))
            for line, state in zip(self.lines, states, strict=True)
        ]
        return OtherRows(listed, after, self.line_heard)

    @property
    def after(self) -> NDArray[np.int64]:
        """How many of the host's rows come before each of the device's."""
        return self.device_after

    def records(self, chosen: Selection | None = None) -> Sequence[Record]:
        """The rows in order as records; the chosen ones, None for all."""
        hosts, devices, others = (
            np.arange(len(places)) if chosen is None else np.flatnonzero(mask)
            for places, mask in zip(self.places, chosen or self.places, strict=True)
        )
        made: list[Record] = [*self._host_records(hosts)]
        made += self._answers(devices, self._states_after(self.after[devices]))
        made += [self.others.listed[row] for row in others.tolist()]
        rows = (hosts, devices, others)
        places = np.concatenate([one[of] for one, of in zip(self.places, rows, strict=True)])
        return list(map(made.__getitem__, np.argsort(places, kind="stable").tolist()))

    @property
    def _alone(self) -> Self:
        """The batch without its rows, for what they call.

        If they held the batch that holds them, all would stay in memory until the garbage collector
        runs, which it hardly ever does among arrays.
        """
        return copy(self)

    def _host_records(self, rows: NDArray[np.int64]) -> Iterator[HostRecord]:
        hosts = self.hosts
        end = objects(hosts.end[rows])
        judged = self._host_judgements(rows)
        return map(
            HostRecord,
            objects(hosts.t[rows]),
            end,
            end,
            repeat("instruction"),
            [judgement.frame for judgement in judged],
            judged,
            hosts.sequence[rows].tolist(),
            self._states_after(rows + 1),
        )

    def _samples(self, rows: NDArray[np.int64]) -> list[DeviceRecord]:
        return self._answers(rows, [self.before] * len(rows))

    def _states_after(self, after: NDArray[np.int64]) -> list[State]:
        states: list[State] = self._states.take(after).tolist()
        return states


def objects(values: NDArray[np.int64]) -> list[int]:
    """Numbers as a list, in which neighbours that are equal are one object."""
    if not len(values):
        return []
    first = np.flatnonzero(np.diff(values, prepend=values[0] - 1))
    return repeated(values[first].tolist(), np.diff(first, append=len(values)))
