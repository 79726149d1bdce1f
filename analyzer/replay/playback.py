"""Plays a capture's events at recorded, faster or slower time, optionally in a time window."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Iterable, Iterator
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
    sleep: Callable[[float], object],
    clock: Callable[[], float] = time.monotonic,
    start: int | None = None,
    end: int | None = None,
) -> Iterator[Paced]:
    """Yield the events needed to decode `start <= t < end` (ns), those inside at their times.

    `rate` 1 is recorded time, 2 twice as fast, 0 without delays. `clock` and `sleep` are in
    seconds, like `time.monotonic` and `time.sleep`. Delays do not add up, since each due time
    counts from the beginning of playing, which is at `start`.

    Events before the window come without delay, because the predicted state and the framing depend
    on them. So do events shortly after it, because they may complete what began inside.
    """
    began: float | None = None
    for event in events:
        if end is not None and event.t > end + AFTERMATH:
            return
        if rate and event.t >= (start or 0) and (end is None or event.t < end):
            began = clock() if began is None else began
            wait = began + (event.t - (start or 0)) / 1e9 / rate - clock()
            if wait > 0:
                sleep(wait)
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
