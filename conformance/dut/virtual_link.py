"""A link to a device object in virtual time: exact, repeatable, as fast as the machine."""

from __future__ import annotations

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
from bilprov.conformance.dut.checked_device import DeviceError
from bilprov.conformance.dut.link import Device


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
