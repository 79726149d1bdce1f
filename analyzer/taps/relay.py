"""Connects two ends by a faulty line until a stop is requested, in one thread with one loop.

Bytes are kept only for their delay, or for a peer that does not read: at most 64 KiB, for 1 s.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TypeAlias

from bilprov.analyzer.taps.impairment import ImpairedDirection
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.forward import Forward
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import open_port, wait_readable
from bilprov.analyzer.transport.pty import PtyPair, open_pty
from bilprov.analyzer.transport.server import Stop

End: TypeAlias = Port | PtyPair

PTY = "pty"  # the name of an end that is made for others to open
_RETRY = 1_000_000  # ns between attempts to forward bytes that a peer did not take


def open_end(name: str, settings: LineSettings) -> End:
    """Open an end: a new pty, or the device at a port. Raises LinkError."""
    return open_pty() if name == PTY else open_port(name, settings)


class _Way:
    """One way of the line: from one end through an impaired direction to the other end.

    `lost` is set once the start failed and all of it was read; `deaf` once the target failed when
    it was written to, whose last words may still be readable.
    """

    def __init__(self, start: End, direction: ImpairedDirection, target: End) -> None:
        self.start = start
        self.direction = direction
        self.lost: LinkError | None = None
        self.deaf: LinkError | None = None
        self._target = target
        self.out = Forward(self._write_some, f"nobody reads what goes from {direction.name}")

    def read(self, deaf: LinkError | None, now: int) -> None:
        """Take in what the start has sent; `deaf` is why it takes nothing any more, if it does."""
        try:
            data = b"" if self.lost else self.start.read()
        except LinkError as error:
            self.lost, data = error, b""
        if not data:
            self.lost = self.lost or deaf
        self.direction.put(data, now)

    def hand_on(self, now: int) -> str:
        """Forward what is due; return a sentence if the peer does not read, else "".

        Raises the LinkError of a lost start, once all bytes from it have been forwarded.
        """
        complaint = self.out.push(self.direction.take(now), now)
        if self.lost is not None and self.direction.deadline is None and not self.out.owed:
            raise self.lost
        return complaint

    def _write_some(self, data: bytes) -> int:
        """Write what the target takes now; for a lost one all bytes are dropped."""
        if self.deaf is None:
            try:
                return self._target.write_some(data)
            except LinkError as error:
                self.deaf = error
        return len(data)


def join(
    ends: tuple[End, End],
    directions: tuple[ImpairedDirection, ImpairedDirection],
    *,
    stop: Stop,
    note: Callable[[str], None],
) -> None:
    """Forward bytes from the first end through the first lane to the second, and back by the other.

    Returns once `stop` is readable. `note` gets a sentence when a peer does not read. Raises the
    LinkError of a lost end, after all bytes from it have been forwarded. Forwarded bytes that no
    program has read from a pty are lost when the pty is closed.
    """
    ways = _Way(ends[0], directions[0], ends[1]), _Way(ends[1], directions[1], ends[0])
    while not _stopped(ways, stop, time.monotonic_ns()):
        for way, other in zip(ways, reversed(ways), strict=True):
            way.read(other.deaf, time.monotonic_ns())
        for way in ways:
            if complaint := way.hand_on(time.monotonic_ns()):
                note(complaint)


def _stopped(ways: Sequence[_Way], stop: Stop, now: int) -> bool:
    """Wait until a way needs a turn; return True once `stop` is readable."""
    starts = [way.start for way in ways if way.lost is None]
    turns = [due for way in ways if (due := way.direction.deadline) is not None]
    turns += [now + _RETRY for way in ways if way.out.owed or way.deaf is not None]
    _, found = wait_readable(
        [start for start in starts if isinstance(start, Port)],
        max(0, min(turns) - now) / 1e9 if turns else None,
        [stop.fileno(), *(start.master for start in starts if isinstance(start, PtyPair))],
    )
    return stop.fileno() in found
