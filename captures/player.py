"""Paces recorded events at recorded, faster or slower time. The clock is passed in."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar


class Timed(Protocol):
    """Anything with a time in ns since the capture's start."""

    @property
    def t(self) -> int:
        """Ns since the capture's start."""
        ...


Event = TypeVar("Event", bound=Timed)


def paced(
    events: Iterable[Event],
    rate: float,
    *,
    clock: Callable[[], float],
    sleep: Callable[[float], object],
    start: int | None = None,
    end: int | None = None,
) -> Iterator[Event]:
    """Yield each event when its time has come.

    `rate` 1 is recorded time, 2 twice as fast, 0 without delays. `clock` and `sleep` are in
    seconds, like `time.monotonic` and `time.sleep`. `start` and `end` (ns since the capture's
    start) select `start <= t < end`; playing begins at `start`, and stops at the first event at or
    after `end`. Delays do not add up, since each due time counts from the beginning of playing.

    Raises ValueError for a rate below 0 or NaN, when called and not at the first event.
    """
    if math.isnan(rate) or rate < 0:
        raise ValueError(f"rate is {rate}, allowed are 0 (as fast as it goes) and above")

    def played() -> Iterator[Event]:
        began = clock()
        for event in events:
            if start is not None and event.t < start:
                continue
            if end is not None and event.t >= end:
                return
            if rate > 0:
                due = began + (event.t - (start or 0)) / 1e9 / rate
                wait = due - clock()
                if wait > 0:
                    sleep(wait)
            yield event

    return played()
