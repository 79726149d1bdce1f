"""A capture's events at recorded, faster or slower time, with a window to look through."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import chain

from analyzer.transport.signals import Stopper
from captures.player import paced
from captures.schemas import Chunk, Line, Look

Event = Chunk | Line | Look

AFTERMATH = 3_000_000_000
"""Ns after a window's end in which what began inside it may still be decided."""


def played(
    events: Iterable[Event],
    rate: float,
    *,
    sleep: Callable[[float], object],
    start: int | None = None,
    end: int | None = None,
) -> Iterator[Event]:
    """Every event that matters for `start <= t < end` (ns), in order; those inside at their time.

    What comes before the window is given at once, because the state and the framing rest on it;
    what comes shortly after it too, because it may decide what began inside.
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
    """A sleep (s) that Ctrl-C ends; at least ten times a second `meanwhile` is told how far it is.

    That is in seconds since it began, and always less than it lasts as a whole.
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
