"""A device object of somebody's own, whose every reply is looked at before the suite takes it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from captures.errors import shown
from captures.schemas import Look
from conformance.dut.link import Device

_METHODS = ("receive", "advance", "deadline")


class DeviceError(TypeError):
    """A device object breaks what `conformance.drive.Device` asks for. One sentence."""


class CheckedDevice:
    """The device, with each method's fault told as one: which method, and what it gave or raised.

    Raises DeviceError where a method is missing.
    """

    def __init__(self, device: Device) -> None:
        for name in _METHODS:
            if not callable(getattr(device, name, None)):
                raise DeviceError(
                    f"the device object {type(device).__name__} has no method {name}; it takes "
                    "receive(bytes, now), advance(now), deadline() and, to be seen, look(now)"
                )
        self._device = device

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that arrive at `now`."""
        self._call("receive", self._device.receive, data, now)

    def advance(self, now: int) -> bytes:
        """What the device sends until `now`."""
        data = self._call("advance", self._device.advance, now)
        if not isinstance(data, bytes):
            raise self._gave("advance", data, "bytes, b'' where it sends nothing")
        return data

    def deadline(self) -> int | None:
        """When it next acts by itself, None if it only waits."""
        due = self._call("deadline", self._device.deadline)
        if due is not None and type(due) is not int:
            raise self._gave("deadline", due, "a time in ns as an int, or None")
        return due

    def look(self, now: int) -> Look:
        """What the wheels and the LED do at `now`."""
        look = self._call("look", self._device.look, now)
        if not isinstance(look, Look):
            raise self._gave("look", look, "a Look (from bilprov import Look)")
        return look

    def power_cycle(self, now: int) -> None:
        """Off and on; only asked of a device that can."""
        self._call("power_cycle", getattr(self._device, "power_cycle"), now)  # noqa: B009

    def _call(self, name: str, method: Callable[..., Any], *arguments: object) -> Any:
        try:
            return method(*arguments)
        except Exception as error:
            what = f"{type(error).__name__}: {shown(error)}"
            raise DeviceError(f"the device's {name} raised {what}") from error

    def _gave(self, name: str, value: object, wanted: str) -> DeviceError:
        return DeviceError(f"the device's {name} gave {shown(repr(value))}; it must give {wanted}")
