"""Plays a capture's events at recorded, faster or slower time, optionally in a time window."""

from __future__ import annotations

import math
import select
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, dropwhile
from typing import TypeVar

from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import Chunk, Line, Look

Event = Chunk | Line | Look
Paced = TypeVar("Paced", bound=Event)

AFTERMATH = 3_000_000_000
"""Ns after a window's end whose events are still needed to decode what began inside it."""


def paced(
    events: Iterable[Paced],
    rate: float,
    *,
    clock: Callable[[], float],
    sleep: Callable[[float], object],
    start: int | None = None,
    end: int | None = None,
) -> Iterator[Paced]:
    """Yield each event when its time has come.

    `rate` 1 is recorded time, 2 twice as fast, 0 without delays. `clock` and `sleep` are in
    seconds, like `time.monotonic` and `time.sleep`. `start` and `end` (ns since the capture's
    start) select `start <= t < end`; playing begins at `start`, and stops at the first event at or
    after `end`. Delays do not add up, since each due time counts from the beginning of playing.

    Raises ValueError for a rate below 0 or NaN, when called and not at the first event.
    """
    if math.isnan(rate) or rate < 0:
        raise ValueError(f"rate is {rate}, allowed are 0 (as fast as it goes) and above")

    def at_their_times() -> Iterator[Paced]:
        began = clock()
        # An older event after one that is played has come late: decoding needs it all the same.
        for event in dropwhile(lambda event: start is not None and event.t < start, events):
            if end is not None and event.t >= end:
                return
            if rate > 0:
                due = began + (event.t - (start or 0)) / 1e9 / rate
                wait = due - clock()
                if wait > 0:
                    sleep(wait)
            yield event

    return at_their_times()


def played(
    events: Iterable[Paced],
    rate: float,
    *,
    sleep: Callable[[float], object],
    start: int | None = None,
    end: int | None = None,
) -> Iterator[Paced]:
    """Yield the events needed to decode `start <= t < end` (ns), in order; those inside are paced.

    Events before the window come without delay, because the predicted state and the framing depend
    on them. So do events shortly after it, because they may complete what began inside.
    """
    rest = iter(events)
    after: list[Paced] = []

    def inside() -> Iterator[Paced]:
        for event in rest:
            if end is not None and event.t >= end:
                after.append(event)
                return
            yield event

    window = inside()
    for event in window:
        if event.t >= (start or 0):
            yield from paced(
                chain([event], window), rate, clock=time.monotonic, sleep=sleep, start=start
            )
            break
        yield event
    yield from after
    for event in rest:
        if end is not None and event.t > end + AFTERMATH:
            return
        yield event


def interruptible(
    stopper: Stopper, meanwhile: Callable[[float], object]
) -> Callable[[float], None]:
    """Make a sleep function (s) that Ctrl-C ends and that reports its progress to `meanwhile`.

    `meanwhile` is called at least ten times a second with the seconds slept so far, which are
    always less than the whole duration.
    """

    def sleep(seconds: float) -> None:
        began = time.monotonic()
        while not stopper.stopped:
            left = began + seconds - time.monotonic()
            if left <= 0:
                return
            select.select([stopper], [], [], min(left, 0.1))
            meanwhile(min(time.monotonic() - began, seconds * 0.999))

    return sleep
