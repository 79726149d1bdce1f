"""Checks every reply of a user's device object before the suite uses it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
