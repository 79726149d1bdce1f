"""A link to a device object in virtual time: exact, repeatable, as fast as the machine.

Every reply of a user's device object is checked before the suite uses it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bilprov.analyzer.client.operations import (
    HELD_ANSWERS,
    LinkListener,
    Listen,
    Observation,
    Observe,
    Operation,
    PowerCycle,
    Received,
    Reply,
    Send,
)
from bilprov.captures.schemas import Look, look_class
from bilprov.conformance.dut.link import Device
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

_METHODS = ("receive", "advance", "deadline")


class DeviceError(UserError, TypeError):
    """A device object breaks the interface `bilprov.conformance.dut.link.Device`. One sentence."""


class CheckedDevice:
    """A device whose every wrong reply or exception becomes a DeviceError that names the method.

    Raises DeviceError where a method is missing. Times are in ns.
    """

    def __init__(self, device: Device, protocol: Protocol) -> None:
        for name in _METHODS:
            if not callable(getattr(device, name, None)):
                raise DeviceError(
                    f"the device object {type(device).__name__} has no method {name}; it takes "
                    "receive(bytes, now), advance(now), deadline() and, to be seen, look(now)"
                )
        self._device = device
        self._looks = look_class(protocol.state_type)

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that arrive at `now`."""
        self._call("receive", self._device.receive, data, now)

    def advance(self, now: int) -> bytes:
        """The bytes the device sends until `now`."""
        data = self._call("advance", self._device.advance, now)
        if not isinstance(data, bytes):
            raise self._gave("advance", data, "bytes, b'' where it sends nothing")
        return data

    def deadline(self) -> int | None:
        """When the device next acts by itself, None if it only waits for bytes."""
        due = self._call("deadline", self._device.deadline)
        if due is not None and type(due) is not int:
            raise self._gave("deadline", due, "a time in ns as an int, or None")
        return due

    def look(self, now: int) -> Look:
        """What the wheels and the LED do at `now`."""
        look = self._call("look", self._device.look, now)
        if not isinstance(look, Look) or not all(
            str(getattr(look, name)).isprintable() for name in look.words
        ):
            raise self._gave("look", look, "an instance of bilprov.Look")
        if isinstance(look, self._looks):
            return look
        told = {name: getattr(look, name, None) for name in self._looks.__struct_fields__[2:]}
        return self._looks(look.t, look.moving, **told)

    def power_cycle(self, now: int) -> None:
        """Switch the device off and on at `now`; called only if the device has this method."""
        self._call("power_cycle", getattr(self._device, "power_cycle"), now)  # noqa: B009

    def _call(self, name: str, method: Callable[..., Any], *arguments: object) -> Any:
        try:
            return method(*arguments)
        except Exception as error:
            what = f"the device's {name} raised {type(error).__name__}: {error}"
            raise DeviceError(what) from error

    def _gave(self, name: str, value: object, wanted: str) -> DeviceError:
        return DeviceError(f"the device's {name} gave {value!r:.200}; it must give {wanted}")


class VirtualLink:
    """Does operations on a device object in virtual time: no waiting, the same result every time.

    `byte_time` is the time of one byte on the wire in ns.
    """

    def __init__(self, device: Device, byte_time: int, tap: LinkListener | None = None) -> None:
        self._device = device
        self._byte_time = byte_time
        self._tap = tap
        self._now = 0
        self._ready = 0
        self._heard: list[tuple[int, int]] = []

    @property
    def now(self) -> int:
        """The virtual time (ns) since the link was made."""
        return self._now

    def do(self, operation: Operation) -> Reply:
        """Do one operation at once. Raises DeviceError for a deadline that does not advance."""
        match operation:
            case Send(data):
                if self._tap:
                    self._tap.sent(data, self._now)
                return self._send(data)
            case Listen(count, patience):
                until = self._now + patience
                self._collect()  # also what is there already, if `patience` is 0
                while self._now < until and (count is None or len(self._heard) < count):
                    due = self._device.deadline()
                    self._pass(until if due is None else min(until, max(due, self._now)))
                    if due is not None and due <= self._now and self._device.deadline() == due:
                        raise DeviceError(
                            f"the device's deadline gave {due} again after advance({self._now}); "
                            "it must give a later time, or None"
                        )
                heard, self._heard = tuple(self._heard), []
                if heard:
                    # An answer takes a byte's time on the wire: the host sends only after it.
                    self._ready = heard[-1][0] + self._byte_time
                return Received(heard[:HELD_ANSWERS], self._now)
            case PowerCycle():
                power = getattr(self._device, "power_cycle")  # noqa: B009  # not every device has
                power(self._now)
                self._heard.clear()
                return self._now
            case Observe():
                look = self._device.look(self._now)
                if self._tap:
                    self._tap.looked(look)
                return Observation(self._now, self._now, look)

    def _send(self, data: bytes) -> int:
        """Send bytes, each with its time on the wire; return when (ns) the last one arrived."""
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
        """Let time pass until `until` (ns); the device acts at each of its deadlines on the way."""
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
