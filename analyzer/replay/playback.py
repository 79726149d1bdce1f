"""Plays a capture's events at recorded, faster or slower time, optionally in a time window."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import chain

from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.player import paced
from bilprov.captures.schemas import Chunk, Line, Look

Event = Chunk | Line | Look

AFTERMATH = 3_000_000_000
"""Ns after a window's end whose events are still needed to decode what began inside it."""


def played(
    events: Iterable[Event],
    rate: float,
    *,
    sleep: Callable[[float], object],
    start: int | None = None,
    end: int | None = None,
) -> Iterator[Event]:
    """Yield the events needed to decode `start <= t < end` (ns), in order; those inside are paced.

    Events before the window come without delay, because the predicted state and the framing depend
    on them. So do events shortly after it, because they may complete what began inside.
    """
    rest = iter(events)
    after: list[Event] = []

    def inside() -> Iterator[Event]:
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
