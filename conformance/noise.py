"""A noisy line around a device: bytes flipped, dropped or doubled both ways, seeded.

It is itself a device, so a run over it is the same every time. The probe is another line: looks
and power pass through it unharmed.
"""

from __future__ import annotations

from dataclasses import dataclass
from random import Random

from captures.schemas import Look
from conformance.drive import Device

_BITS = 8


@dataclass(frozen=True, slots=True)
class Noise:
    """How likely (0 to 1) a byte on the line is flipped in one bit, dropped, or doubled.

    Raises ValueError for a probability outside 0 to 1, and if together they exceed 1.
    """

    flipped: float = 0.0
    dropped: float = 0.0
    doubled: float = 0.0

    def __post_init__(self) -> None:
        chances = (self.flipped, self.dropped, self.doubled)
        if min(chances) < 0 or sum(chances) > 1:
            raise ValueError(
                f"the noise is {self.flipped:g} flipped, {self.dropped:g} dropped and "
                f"{self.doubled:g} doubled; each is 0 to 1, and all of them together at most 1"
            )

    def over(self, data: bytes, chance: Random) -> bytes:
        """What arrives of the bytes that were sent."""
        arrived = bytearray()
        for byte in data:
            drawn = chance.random()
            if drawn < self.flipped:
                arrived.append(byte ^ 1 << chance.randrange(_BITS))
            elif drawn < self.flipped + self.dropped:
                continue
            elif drawn < self.flipped + self.dropped + self.doubled:
                arrived += bytes([byte, byte])
            else:
                arrived.append(byte)
        return bytes(arrived)


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
