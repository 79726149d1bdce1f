"""A wire to a robot: sends bytes, receives answers with their times. Used to drive and home it."""

from __future__ import annotations

import time
from typing import Protocol, TypeAlias

from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import wait_readable

HELD = 1 << 16
"""Answers kept per call of `listen`, so that a flooding device does not fill the memory."""

Heard: TypeAlias = tuple[tuple[int, int], ...]
"""Answer bytes, each as (time in ns, byte)."""


class Wire(Protocol):
    """A line to one robot. Times are ns on the wire's own clock."""

    def send(self, data: bytes) -> int:
        """Send bytes and return the time (ns) when the last one was sent.

        Raises LinkError, or an error of the implementation's own.
        """

    def listen(self, count: int | None, patience: int) -> Heard:
        """Wait for `count` answers (None: any number), at most `patience` ns after the last send.

        Returns all answers since the last call.
        """


class PortWire:
    """A wire over an open port, in real time."""

    def __init__(self, port: Port) -> None:
        self._port = port
        self._sent = 0

    def send(self, data: bytes) -> int:
        """Send bytes and return the time (ns) when the last one was sent. Raises LinkError."""
        begun = time.monotonic_ns()
        self._port.write(data)
        self._sent = max(time.monotonic_ns(), begun + len(data) * self._port.byte_time)
        return self._sent

    def listen(self, count: int | None, patience: int) -> Heard:
        """Read until `count` answers came or the time is over. Raises LinkError."""
        until = max(time.monotonic_ns(), self._sent) + patience
        heard: list[tuple[int, int]] = []
        while True:
            data = self._port.read()
            now = time.monotonic_ns()
            heard += [(now, byte) for byte in data[: HELD - len(heard)]]
            if (count is not None and len(heard) >= count) or now >= until:
                return tuple(heard)
            wait_readable([self._port], (until - now) / 1e9)
