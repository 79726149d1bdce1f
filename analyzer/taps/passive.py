"""Passive taps: listens to one or two ports and yields their chunks and line events.

One loop polls the taps; all times `t` are in ns (monotonic) since the taps were made.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

from bilprov.analyzer.taps.source import Source
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import open_port, same_line, wait_readable
from bilprov.captures.schemas import Chunk, Line


def require_two_lines(host: str, device: str) -> None:
    """Raise ValueError if both names mean the same line (also through a symbolic link).

    Call this before opening: opening a path twice would only report that it is in use.
    """
    if same_line(host, device):
        raise ValueError(
            f"host and device are both tapped at {device}; a tap hears one direction, so give two"
        )


class Taps(Source):
    """Two passive taps, or one (with `device` None, for the host alone); they never write.

    If one is lost, the other is still listened to; `ended` is true once both are lost. `close`
    closes the ports. Raises ValueError if both are the same line.
    """

    def __init__(self, host: Port, device: Port | None) -> None:
        if device is not None:
            require_two_lines(host.name, device.name)
        super().__init__({"host": host} if device is None else {"host": host, "device": device})
        self.heard = frozenset(self._ports)

    def poll(self, timeout_s: float | None, also: Sequence[int] = ()) -> list[Chunk | Line]:
        """Return the new events, as every source does."""
        events: list[Chunk | Line] = []
        if self.ended:
            return events
        ready, _ = wait_readable(list(self._ports.values()), timeout_s, also)
        for tap in [tap for tap, port in self._ports.items() if port in ready]:
            self._read(tap, events)
        self._count(events)
        return events


def open_taps(settings: LineSettings, host: str, device: str | None = None) -> Taps:
    """Open the tap on `host`, and the one on `device` unless it is None.

    Raises ValueError if both are the same line, LinkError for a port that cannot be opened.
    """
    if device is not None:
        require_two_lines(host, device)
    with ExitStack() as opened:
        first = opened.enter_context(open_port(host, settings))
        taps = Taps(first, None if device is None else open_port(device, settings))
        opened.pop_all()
    return taps
