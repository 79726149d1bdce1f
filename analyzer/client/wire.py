"""A wire to a robot: sends bytes, receives answers with their times; homes the robot on it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol, TypeAlias

from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import wait_readable
from bilprov.captures.schemas import MS
from bilprov.spec.protocol import Protocol as Grammar

HELD = 1 << 16
"""Answers kept per call of `listen`, so that a flooding device does not fill the memory."""

Heard: TypeAlias = tuple[tuple[int, int], ...]
"""Answer bytes, each as (time in ns, byte)."""

_TRIES = 5  # an opened Arduino resets, and boots for some seconds
_SLOWER = 4  # how much later than the first answer one of the others may come
_SETTLE = 2 * MS  # ns after the last answer in which a surplus answer comes


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


def home(protocol: Grammar, wire: Wire, given_up: Callable[[], bool] = lambda: False) -> bool:
    """Home until the robot answers, in a limited number of tries; return whether it did.

    `given_up` is called after each try without an answer; if it returns true, no more are made.
    """
    for _ in range(_TRIES):
        if home_once(protocol, wire):
            return True
        if given_up():
            break
    return False


def home_once(protocol: Grammar, wire: Wire) -> bool:
    """Send stops to complete any frame the robot may be in; return whether it answered.

    Stops that the robot takes as missing data have no answer of their own, so the wait ends after
    a pause without an answer. The first answer's latency lengthens that pause for a slow robot.
    """
    timing = protocol.timing
    count = protocol.longest_frame
    wire.listen(None, 0)
    sent = wire.send(stops(protocol))
    heard = 0
    patience = round(timing.answer_longest * MS)
    pause = round(max(timing.answer_deadline, timing.truncation_timeout) * MS)
    while heard < count and (more := wire.listen(1, patience)):
        if not heard:
            patience = max(pause, _SLOWER * (more[0][0] - sent))
        heard += len(more)
    wire.listen(None, _SETTLE)
    return heard > 0


def stops(protocol: Grammar) -> bytes:
    """Stop instructions, as many as the longest frame has bytes.

    They fill any open frame, and at least one is left over as an instruction.
    """
    return bytes([protocol.pad_byte]) * protocol.longest_frame
