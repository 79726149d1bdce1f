"""The base of passive taps and the bridge: a source of chunks and line events with times."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence

from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.port import Port
from bilprov.captures.closing import Closing
from bilprov.captures.schemas import Chunk, Direction, Line

_COUNT_EVERY = 100_000_000  # ns between readings of a driver's error counts


def counted(
    t: int, tap: Direction, before: Mapping[str, int], after: Mapping[str, int]
) -> Iterator[Line]:
    """Yield a Line event for each kind of error that a driver has counted since `before`."""
    for kind, total in after.items():
        more = total - before.get(kind, 0)
        if more > 0:
            yield Line(t, kind, tap, f"{more} counted by the driver")


class Source(Closing):
    """A source of events: a clock, and one port per direction with its error counts.

    `names` are the names of the ports by role, `heard` the directions that are listened to, and
    `served` the name under which the host program opens the source, "" if there is none.
    `one_clock` is true if one clock stamps both directions; `attached` is true if traffic may have
    passed before listening began.
    """

    heard: frozenset[Direction] = frozenset({"host", "device"})
    one_clock = False
    attached = True
    served = ""

    def __init__(self, ports: Mapping[Direction, Port]) -> None:
        self.names = {str(tap): port.name for tap, port in ports.items()}
        self._ports = dict(ports)  # the ports that are not lost, host before device
        self._all = tuple(ports.values())
        self._counts = {tap: port.error_counts() for tap, port in ports.items()}
        self.start_wall = time.time_ns()
        self._start = self._counted_at = time.monotonic_ns()

    @property
    def ended(self) -> bool:
        """Whether all ports are lost."""
        return not self._ports

    def now(self) -> int:
        """Return the time since the start in ns."""
        return time.monotonic_ns() - self._start

    @abstractmethod
    def poll(self, timeout_s: float | None, also: Sequence[int] = ()) -> list[Chunk | Line]:
        """Return the new events in order, after waiting at most `timeout_s` s for the first.

        `also` are descriptors (such as a Stopper's) that end the wait too. When both sides have
        bytes the host comes first, since an instruction is older than its answer.
        """

    def close(self) -> None:
        """Close the ports; further calls do nothing."""
        self._ports.clear()
        for port in self._all:
            port.close()

    def _read(self, tap: Direction, events: list[Chunk | Line]) -> bytes:
        """Append the next chunk of one side, or its `unplugged`; return the chunk's bytes."""
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
        """Append events for new driver errors, at most every 0.1 s; few drivers count errors."""
        if time.monotonic_ns() - self._counted_at < _COUNT_EVERY:
            return
        self._counted_at = time.monotonic_ns()
        for tap, port in self._ports.items():
            before = self._counts[tap]
            after = None if before is None else port.error_counts()
            if before is not None and after is not None:
                events += counted(self.now(), tap, before, after)
                self._counts[tap] = after
