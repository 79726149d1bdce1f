"""Where the sniffer's chunks come from: two passive taps, or a bridge that a host talks through.

A source is polled by one loop; all times `t` are in ns (monotonic) since the source was made.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from analyzer.transport.forward import Forward
from analyzer.transport.ports import LinkError, Port, open_pty, wait_readable
from captures.closing import Closing
from captures.schemas import Chunk, Direction, Line

_COUNT_EVERY = 100_000_000  # ns between looks at a driver's error counts
_RETRY = 0.005  # s between tries to hand on what a peer did not take


def require_two_lines(host: str, device: str) -> None:
    """Raise ValueError where both names mean one line (also through a symbolic link).

    Ask before opening: the second opening of a path would only say that it is in use.
    """
    if host == device or ("://" not in host + device and _resolved(host) == _resolved(device)):
        raise ValueError(
            f"host and device are both tapped at {device}; a tap hears one direction, so give two"
        )


def counted(
    t: int, tap: Direction, before: Mapping[str, int], after: Mapping[str, int]
) -> Iterator[Line]:
    """Yield a Line event for each kind of error that a driver has counted since `before`."""
    for kind, total in after.items():
        more = total - before.get(kind, 0)
        if more > 0:
            yield Line(t, kind, tap, f"{more} counted by the driver")


class _Source(Closing):
    """What taps and bridge share: the clock, and one port per direction with its error counts."""

    def __init__(self, ports: Mapping[Direction, Port]) -> None:
        self._ports = dict(ports)  # the sides that are left, host before device
        self._all = tuple(ports.values())
        self._counts = {tap: port.error_counts() for tap, port in ports.items()}
        self.start_wall = time.time_ns()
        self._start = self._counted_at = time.monotonic_ns()

    @property
    def ended(self) -> bool:
        """Whether no line is left to listen to."""
        return not self._ports

    def now(self) -> int:
        """Return the time since the start in ns."""
        return time.monotonic_ns() - self._start

    def close(self) -> None:
        """Close the ports; more than once is as good as once."""
        self._ports.clear()
        for port in self._all:
            port.close()

    def _read(self, tap: Direction, events: list[Chunk | Line]) -> bytes:
        """Append the chunk that one side gives now, or its end; return the chunk's bytes."""
        try:
            data = self._ports[tap].read()
        except LinkError as error:
            del self._ports[tap]
            events.append(Line(self.now(), "unplugged", tap, str(error)))
            return b""
        if data:
            events.append(Chunk(self.now(), tap, data))
        return data

    def _count(self, events: list[Chunk | Line]) -> None:
        """Append what the drivers have counted, at most every 0.1 s; few drivers count at all."""
        if time.monotonic_ns() - self._counted_at < _COUNT_EVERY:
            return
        self._counted_at = time.monotonic_ns()
        for tap, port in self._ports.items():
            before = self._counts[tap]
            after = None if before is None else port.error_counts()
            if before is not None and after is not None:
                events += counted(self.now(), tap, before, after)
                self._counts[tap] = after


class Taps(_Source):
    """Two passive taps, or one (`device` None hears only the host); nothing is ever written.

    When one has gone the other is listened to alone; `ended` once both have. Closes the ports.
    Raises ValueError where both are the same line.
    """

    def __init__(self, host: Port, device: Port | None) -> None:
        if device is not None:
            require_two_lines(host.name, device.name)
        super().__init__({"host": host} if device is None else {"host": host, "device": device})

    def poll(self, timeout_s: float | None, also: Sequence[int] = ()) -> list[Chunk | Line]:
        """Return what has come, in order, after waiting at most `timeout_s` s for the first of it.

        `also` are descriptors (a Stopper's) that end the wait too. When both sides are readable
        the host comes first: what it said is older than the answer to it.
        """
        events: list[Chunk | Line] = []
        if self.ended:
            return events
        ready, _ = wait_readable(list(self._ports.values()), timeout_s, also)
        for tap in [tap for tap, port in self._ports.items() if port in ready]:
            self._read(tap, events)
        self._count(events)
        return events


class Bridge(_Source):
    """A pty for the host program, joined to the device's port: every byte passes and is recorded.

    The host program opens `pty_name`; what it sets there (baud rate, DTR) stays there. Nobody has
    to have it open. A side that does not read never holds up the other or the recording: what it
    does not take for a second is dropped, which a Line event `gap` says, on the tap whose bytes
    were dropped; they are recorded all the same. `ended` once the device has gone. Closes the port.
    """

    def __init__(self, port: Port) -> None:
        super().__init__({"device": port})
        self._pty = open_pty()
        self.pty_name = self._pty.name
        self._port = port
        self._to_device = Forward(port.write_some, "the device does not read")
        self._to_host = Forward(self._pty.write_some, "the host program does not read")

    def poll(self, timeout_s: float | None, also: Sequence[int] = ()) -> list[Chunk | Line]:
        """Return what has come, in order, after waiting at most `timeout_s` s for the first of it.

        `also` are descriptors (a Stopper's) that end the wait too. The host comes first.
        """
        events: list[Chunk | Line] = []
        if self.ended:
            return events
        if self._to_device.owed or self._to_host.owed:
            timeout_s = _RETRY if timeout_s is None else min(timeout_s, _RETRY)
        ready, _ = wait_readable([self._port], timeout_s, [self._pty.master, *also])
        said = self._pty.read()
        if said:
            events.append(Chunk(self.now(), "host", said))
        self._hand_on(self._to_device, said, "host", events)
        answered = self._read("device", events) if ready else b""
        self._hand_on(self._to_host, answered, "device", events)
        self._count(events)
        return events

    def close(self) -> None:
        """Close the pty and the port; more than once is as good as once."""
        self._pty.close()
        super().close()

    def _hand_on(
        self, forward: Forward, data: bytes, tap: Direction, events: list[Chunk | Line]
    ) -> None:
        dropped = forward.push(data, self.now())
        if dropped:
            events.append(Line(self.now(), "gap", tap, dropped))


def _resolved(name: str) -> Path:
    return Path(name).resolve()
