"""Connects two ends by a faulty line until a stop is requested, in one thread with one loop.

Bytes are kept only for their delay, or for a peer that does not read: at most 64 KiB, for 1 s.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from bilprov.analyzer.taps.ends import End
from bilprov.analyzer.taps.impairment import ImpairedDirection
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.forward import Forward
from bilprov.analyzer.transport.ports import wait_readable
from bilprov.analyzer.transport.server import Stop
from bilprov.analyzer.transport.streams import FULL_REST, NO_DESCRIPTOR

_RETRY = 1_000_000  # ns between attempts to forward bytes that a peer did not take


class _Side:
    """An end with its error state: `lost` is set once the end failed and all of it was read."""

    def __init__(self, end: End) -> None:
        self.end = end
        self.lost: LinkError | None = None
        self.deaf: LinkError | None = None  # writing failed; bytes it sent may still be readable

    def read(self) -> bytes:
        """Return the available bytes, b"" if there are none now or the end is lost."""
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
        """Write what the end takes now; for a lost end all bytes are dropped."""
        if self.lost is None and self.deaf is None:
            try:
                return self.end.write_some(data)
            except LinkError as error:
                self.deaf = error
        return len(data)


class _Way:
    """One way of the line: from one side through an impaired direction to the other side."""

    def __init__(self, start: _Side, direction: ImpairedDirection, target: _Side) -> None:
        self.start = start
        self.direction = direction
        self.out = Forward(target.write_some, f"nobody reads what goes from {direction.name}")

    def wanted(self, now: int) -> int | None:
        """Return when (ns) this way next needs a turn without new bytes, None if it does not."""
        soon = now + _RETRY if self.out.owed or self.start.deaf is not None else None
        return min((t for t in (self.direction.deadline, soon) if t is not None), default=None)

    def require_more(self) -> None:
        """Raise the LinkError of a lost start, once all bytes from it have been forwarded."""
        if self.start.lost is not None and self.direction.deadline is None and not self.out.owed:
            raise self.start.lost


def join(
    ends: tuple[End, End],
    directions: tuple[ImpairedDirection, ImpairedDirection],
    *,
    stop: Stop,
    note: Callable[[str], None],
    clock: Callable[[], int] = time.monotonic_ns,
) -> None:
    """Forward bytes from the first end through the first lane to the second, and back by the other.

    Returns once `stop` is readable. `note` gets a sentence when a peer does not read, and when no
    file descriptor is free for one that connects. Raises the LinkError of a lost end, after all
    bytes from it have been forwarded. Forwarded bytes that no program has read from a pty are lost
    when the pty is closed.
    """
    a, b = _Side(ends[0]), _Side(ends[1])
    ways = _Way(a, directions[0], b), _Way(b, directions[1], a)
    told_full = False
    while not _stopped(ways, stop, clock()):
        for way in ways:
            data = way.start.read()
            way.direction.put(data, clock())
        if not told_full and any(end.full for end in ends):
            told_full = True
            note(NO_DESCRIPTOR)
        for way in ways:
            now = clock()
            complaint = way.out.push(way.direction.take(now), now)
            if complaint:
                note(complaint)
            way.require_more()


def _stopped(ways: Sequence[_Way], stop: Stop, now: int) -> bool:
    """Wait until a way needs a turn; return True once `stop` is readable."""
    ends = [way.start.end for way in ways if way.start.lost is None]
    turns = [t for way in ways if (t := way.wanted(now)) is not None]
    turns += [now + FULL_REST for end in ends if end.full]
    _, found = wait_readable(
        [end.port for end in ends if end.port is not None],
        max(0, min(turns) - now) / 1e9 if turns else None,
        [stop.fileno(), *(fd for end in ends for fd in end.descriptors())],
    )
    return stop.fileno() in found
