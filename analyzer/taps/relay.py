"""Join two ends by a faulty line until told to stop: one thread, one loop.

Nothing is kept longer than its delay, except for a peer that does not read: 64 KiB, for 1 s.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from analyzer.taps.ends import End
from analyzer.taps.impairment import Lane
from analyzer.transport.forward import Forward
from analyzer.transport.ports import LinkError, wait_readable
from analyzer.transport.server import Stop

_RETRY = 1_000_000  # ns between tries to hand on what a peer did not take


class _Side:
    """An end, and why nothing comes from it any more: `lost`, once all has been read."""

    def __init__(self, end: End) -> None:
        self.end = end
        self.lost: LinkError | None = None
        self.deaf: LinkError | None = None  # it takes nothing; what it had sent may still be there

    def read(self) -> bytes:
        """Return what has come; b"" is nothing now, or never again."""
        if self.lost is not None:
            return b""
        try:
            data = self.end.read()
        except LinkError as error:
            self.lost = error
            return b""
        if not data:
            self.lost = self.deaf
        return data

    def write_some(self, data: bytes) -> int:
        """Write what is taken now; an end that has gone takes all of it to nowhere."""
        if self.lost is None and self.deaf is None:
            try:
                return self.end.write_some(data)
            except LinkError as error:
                self.deaf = error
        return len(data)


class _Way:
    """From one side through a lane to the other."""

    def __init__(self, start: _Side, lane: Lane, target: _Side) -> None:
        self.start = start
        self.lane = lane
        self.out = Forward(target.write_some, f"nobody reads what goes from {lane.name}")

    def wanted(self, now: int) -> int | None:
        """Return when this way next wants a turn by itself, in ns; None: not before bytes come."""
        soon = now + _RETRY if self.out.owed or self.start.deaf is not None else None
        return min((t for t in (self.lane.deadline, soon) if t is not None), default=None)

    def require_more(self) -> None:
        """Raise the LinkError of a lost start, once what came from it has been handed on."""
        if self.start.lost is not None and self.lane.deadline is None and not self.out.owed:
            raise self.start.lost


def join(
    ends: tuple[End, End],
    lanes: tuple[Lane, Lane],
    *,
    stop: Stop,
    note: Callable[[str], None],
    clock: Callable[[], int] = time.monotonic_ns,
) -> None:
    """Carry bytes from the first end through the first lane to the second, and back by the second.

    Returns once `stop` is readable. `note` gets a sentence when a peer does not read. Raises the
    LinkError of an end that was lost, after what had come from it has been handed on; of that a pty
    keeps nothing that its program has not read when it is closed.
    """
    a, b = _Side(ends[0]), _Side(ends[1])
    ways = _Way(a, lanes[0], b), _Way(b, lanes[1], a)
    while not _stopped(ways, stop, clock()):
        for way in ways:
            data = way.start.read()
            way.lane.put(data, clock())
        for way in ways:
            now = clock()
            complaint = way.out.push(way.lane.take(now), now)
            if complaint:
                note(complaint)
            way.require_more()


def _stopped(ways: Sequence[_Way], stop: Stop, now: int) -> bool:
    """Wait until there is something to do; True once `stop` is readable."""
    ends = [way.start.end for way in ways if way.start.lost is None]
    turns = [t for way in ways if (t := way.wanted(now)) is not None]
    _, found = wait_readable(
        [end.port for end in ends if end.port is not None],
        max(0, min(turns) - now) / 1e9 if turns else None,
        [stop.fileno(), *(fd for end in ends for fd in end.descriptors())],
    )
    return stop.fileno() in found
