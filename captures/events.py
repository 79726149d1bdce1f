"""The events of a line as arrays: when each came, from which side, and the bytes of all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bilprov.captures.schemas import Chunk, Direction, Line

SIDES: tuple[Direction, Direction] = ("host", "device")
"""The sides in the order of their codes in `Events.side`."""

HOST, DEVICE, LINE = range(3)
"""The codes in `Events.side`: bytes of the host, bytes of the device, a line event."""


@dataclass(frozen=True, eq=False)
class Events:
    """Some events in order, one row each; those of a capture as they were stored.

    `t` are times in ns since the capture's start, `side` is HOST, DEVICE or LINE, `size` the number
    of bytes (0 for a line event). `data` has the bytes of all rows, joined in order, and `lines`
    the line events in order.
    """

    t: NDArray[np.int64]
    side: NDArray[np.uint8]
    size: NDArray[np.int64]
    data: NDArray[np.uint8]
    lines: tuple[Line, ...] = ()

    @classmethod
    def of(cls, events: Sequence[Chunk | Line]) -> Events:
        """The rows of single events. Raises OverflowError for a time beyond 64 bits."""
        side = [
            LINE if isinstance(event, Line) else SIDES.index(event.direction) for event in events
        ]
        chunks = [b"" if isinstance(event, Line) else event.data for event in events]
        return cls(
            t=np.array([event.t for event in events], np.int64),
            side=np.array(side, np.uint8),
            size=np.array([len(chunk) for chunk in chunks], np.int64),
            data=np.frombuffer(b"".join(chunks), np.uint8),
            lines=tuple(event for event in events if isinstance(event, Line)),
        )

    @classmethod
    def joined(cls, parts: Sequence[Events | Line]) -> Events:
        """The rows of some parts and single line events, in order."""
        arrays: list[Events] = []
        for is_line, group in groupby(parts, lambda part: isinstance(part, Line)):
            members: list[Any] = list(group)
            arrays += [cls.of(members)] if is_line else members
        if len(arrays) == 1:
            return arrays[0]
        return cls(
            np.concatenate([part.t for part in arrays]),
            np.concatenate([part.side for part in arrays]),
            np.concatenate([part.size for part in arrays]),
            np.concatenate([part.data for part in arrays]),
            tuple(line for part in arrays for line in part.lines),
        )

    def __len__(self) -> int:
        return len(self.t)

    @cached_property
    def end(self) -> NDArray[np.int64]:
        """Where in `data` each row's bytes end."""
        return np.cumsum(self.size)

    @cached_property
    def side_of_byte(self) -> NDArray[np.uint8]:
        """The side of each byte of `data`."""
        return np.repeat(self.side, self.size)

    def part(self, start: int, stop: int) -> Events:
        """The rows from `start` up to, not including, `stop`."""
        first = int(self.end[start - 1]) if start else 0
        last = int(self.end[stop - 1]) if stop else 0
        before = np.count_nonzero(self.side[:start] == LINE) if self.lines else 0
        inside = np.count_nonzero(self.side[start:stop] == LINE) if self.lines else 0
        return Events(
            self.t[start:stop],
            self.side[start:stop],
            self.size[start:stop],
            self.data[first:last],
            self.lines[before : before + inside],
        )

    def single(self) -> Iterator[Chunk | Line]:
        """Yield the rows as single events."""
        lines = iter(self.lines)
        data = self.data.tobytes()
        end = 0
        rows = zip(self.t.tolist(), self.side.tolist(), self.size.tolist(), strict=True)
        for t, side, size in rows:
            if side == LINE:
                yield next(lines)
            else:
                yield Chunk(t, SIDES[side], data[end : end + size])
                end += size
