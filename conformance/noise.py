"""A noisy line around a device: bytes flipped, dropped or doubled both ways, seeded.

It is itself a device, so a run over it is the same every time. The probe is another line: looks
and power pass through it unharmed.
"""

from __future__ import annotations

from random import Random

from analyzer.noise import Noise
from captures.schemas import Look
from conformance.drive import Device

__all__ = ["Noise", "NoisyDevice"]


class NoisyDevice:
    """A device behind a noisy line; `hurt` counts the bytes that came out otherwise than sent."""

    def __init__(self, device: Device, noise: Noise, seed: int) -> None:
        self._device = device
        self._noise = noise
        self._chance = Random(seed)
        self.hurt = 0

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that arrive at `now` (ns): what the line leaves of them."""
        arrived = self._through(data)
        if arrived:
            self._device.receive(arrived, now)

    def advance(self, now: int) -> bytes:
        """Let time pass until `now` (ns): what the line leaves of what the device sends."""
        sent = self._device.advance(now)
        return self._through(sent) if sent else sent

    def deadline(self) -> int | None:
        """When the device next acts by itself, None if it only waits."""
        return self._device.deadline()

    def look(self, now: int) -> Look:
        """What the wheels and the LED do at `now` (ns)."""
        return self._device.look(now)

    def power_cycle(self, now: int) -> None:
        """Switch the device off and on at `now` (ns)."""
        power = getattr(self._device, "power_cycle")  # noqa: B009  # not every device has one
        power(now)

    def _through(self, data: bytes) -> bytes:
        arrived = self._noise.over(data, self._chance)
        self.hurt += arrived != data
        return arrived
