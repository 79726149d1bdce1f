"""Does what a script asks: on a device object in virtual time, or on a real port and probe."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from captures.schemas import Look
from conformance.dut.operations import Ask, Heard, Listen, PowerCycle, Script, See, Seen, Send
from conformance.runner.run import Ended

T = TypeVar("T")


HELD = 1 << 16
"""Answers kept between two asks: a device that floods must not fill the memory."""


class Device(Protocol):
    """A device under test without I/O: bytes and times (ns) in, answers and looks out."""

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that arrive at `now`."""

    def advance(self, now: int) -> bytes:
        """Let time pass until `now`: what the device sends until then."""

    def deadline(self) -> int | None:
        """When it next acts by itself, None if it only waits."""

    def look(self, now: int) -> Look:
        """What the wheels and the LED do at `now`."""


class Tap(Protocol):
    """Hears everything that a link does, for a recording."""

    def sent(self, data: bytes, t: int) -> None:
        """Bytes that went to the device."""

    def received(self, data: bytes, t: int) -> None:
        """Bytes that came from it."""

    def looked(self, look: Look) -> None:
        """A reading of the probe."""


class Link(Protocol):
    """Something that can do asks."""

    def do(self, ask: Ask) -> int | Heard | Seen:
        """Do one ask. Raises conformance.run.Ended when it cannot."""


def drive(script: Script[T], link: Link, interrupted: Callable[[], bool | str]) -> T:
    """Run a script over a link to its end and return what it returns.

    `interrupted` is asked before each ask; the first time that it says so the script is told, and
    then only homes the robot. True is the user's wish, a sentence says what of the kit failed.
    """
    reply: Any = None
    error: BaseException | None = None
    told = False
    while True:
        try:
            ask = script.throw(error) if error else script.send(reply)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]  # what the generator's type says
        error = None
        if not told and (why := interrupted()):
            told = True
            error = interruption(why)
            continue
        try:
            reply = link.do(ask)
        except Ended as ended:
            error = ended


def interruption(why: bool | str) -> Ended:
    """What a script is told: True is the user's wish, a sentence says what of the kit failed."""
    failed = isinstance(why, str)
    return Ended(str(why) if failed else "interrupted", error=failed, line_works=True)


class VirtualLink:
    """A device object in virtual time: no waiting, the same result every time.

    `byte_time` is the time of one byte on the wire in ns.
    """

    def __init__(self, device: Device, byte_time: int, tap: Tap | None = None) -> None:
        self._device = device
        self._byte_time = byte_time
        self._tap = tap
        self._now = 0
        self._ready = 0
        self._heard: list[tuple[int, int]] = []

    def do(self, ask: Ask) -> int | Heard | Seen:
        """Do one ask at once."""
        match ask:
            case Send(data):
                if self._tap:
                    self._tap.sent(data, self._now)
                return self._send(data)
            case Listen(count, patience):
                until = self._now + patience
                self._collect()  # also what is there already, where nobody waits
                while self._now < until and (count is None or len(self._heard) < count):
                    due = self._device.deadline()
                    self._pass(until if due is None else min(until, max(due, self._now)))
                    if due is not None and due <= self._now and self._device.deadline() == due:
                        raise RuntimeError("the device's deadline does not advance")
                heard, self._heard = tuple(self._heard), []
                if heard:
                    # An answer takes its time on the wire: who waited for it sends only then.
                    self._ready = heard[-1][0] + self._byte_time
                return Heard(heard[:HELD], self._now)
            case PowerCycle():
                power = getattr(self._device, "power_cycle")  # noqa: B009  # not every device has
                power(self._now)
                self._heard.clear()
                return self._now
            case See():
                look = self._device.look(self._now)
                if self._tap:
                    self._tap.looked(look)
                return Seen(self._now, self._now, look)

    def _send(self, data: bytes) -> int:
        """Send byte by byte, each in its time on the wire."""
        device, byte_time = self._device, self._byte_time
        if self._now < self._ready:
            self._pass(self._ready)
        for index in range(len(data)):
            arrives = self._now + byte_time
            due = device.deadline()
            if due is not None and due <= arrives:
                self._pass(arrives)
            self._now = arrives
            device.receive(data[index : index + 1], arrives)
            self._collect()
        return self._now

    def _pass(self, until: int) -> None:
        """Let time pass; what the device does on its way happens at its own time."""
        while (due := self._device.deadline()) is not None and self._now < due < until:
            self._now = due
            self._collect()
        self._now = until
        self._collect()

    def _collect(self) -> None:
        data = self._device.advance(self._now)
        if data:
            self._heard += [(self._now, byte) for byte in data]
            if self._tap:
                self._tap.received(data, self._now)
