"""Bytes to a robot, and its answers with their times: what drives and homes it stands on this."""

from __future__ import annotations

import time
from typing import Protocol, TypeAlias

from analyzer.transport.port import Port
from analyzer.transport.ports import wait_readable

HELD = 1 << 16
"""Answers kept of one listening: a device that floods must not fill the memory."""

Heard: TypeAlias = tuple[tuple[int, int], ...]
"""Answer bytes, each as (time in ns, byte)."""


class Wire(Protocol):
    """A line to one robot. Times are ns on the wire's own clock."""

    def send(self, data: bytes) -> int:
        """Send bytes; the time when the last one had gone. Raises LinkError, or its user's own."""

    def listen(self, count: int | None, patience: int) -> Heard:
        """Wait for `count` answers (None: never enough) or `patience` ns after the last byte sent.

        Gives all that came since the last listening.
        """


class PortWire:
    """The wire that a port is, in real time."""

    def __init__(self, port: Port) -> None:
        self._port = port
        self._sent = 0

    def send(self, data: bytes) -> int:
        """Send bytes. Raises LinkError."""
        begun = time.monotonic_ns()
        self._port.write(data)
        self._sent = max(time.monotonic_ns(), begun + len(data) * self._port.byte_time)
        return self._sent

    def listen(self, count: int | None, patience: int) -> Heard:
        """Read until there is enough or the time is over. Raises LinkError."""
        until = max(time.monotonic_ns(), self._sent) + patience
        heard: list[tuple[int, int]] = []
        while True:
            data = self._port.read()
            now = time.monotonic_ns()
            heard += [(now, byte) for byte in data[: HELD - len(heard)]]
            if (count is not None and len(heard) >= count) or now >= until:
                return tuple(heard)
            wait_readable([self._port], (until - now) / 1e9)
