"""A device behind a bad line: bytes flipped, dropped, doubled and delayed both ways, seeded.

It is itself a device, so a run over it is the same every time. The probe is another line:
observations and power cycles are not affected.
"""

from __future__ import annotations

from bilprov.analyzer.taps.relay import ImpairedDirection, Noise
from bilprov.captures.schemas import Look
from bilprov.conformance.dut.target import Device


class NoisyDevice:
    """A device behind a bad line.

    Each byte takes `delay` ns in each direction besides its time on the wire, and up to `jitter` ns
    more; the order of bytes stays.
    """

    def __init__(
        self, device: Device, noise: Noise, seed: int, delay: int = 0, jitter: int = 0
    ) -> None:
        self._device = device
        self._inward, self._outward = (
            ImpairedDirection(noise, seed, way, delay=delay, jitter=jitter)
            for way in ("to the device", "from the device")
        )

    @property
    def hurt(self) -> int:
        """How many bytes the noise changed."""
        ways = (self._inward, self._outward)
        return sum(way.dropped + way.flipped + way.doubled for way in ways)

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that enter the line at `now` (ns)."""
        self._deliver(now)
        self._inward.put(data, now)
        self._deliver(now)

    def advance(self, now: int) -> bytes:
        """Let time pass until `now` (ns); return the device's bytes that have come through."""
        self._deliver(now)
        return self._outward.take(now)

    def deadline(self) -> int | None:
        """When (ns) bytes next arrive or the device acts by itself; None if it only waits."""
        due = (self._inward.deadline, self._outward.deadline, self._device.deadline())
        return min((time for time in due if time is not None), default=None)

    def look(self, now: int) -> Look:
        """What the wheels and the LED do at `now` (ns)."""
        self._deliver(now)
        return self._device.look(now)

    def power_cycle(self, now: int) -> None:
        """Switch the device off and on at `now` (ns)."""
        power = getattr(self._device, "power_cycle")  # noqa: B009  # not every device has one
        power(now)

    def _deliver(self, now: int) -> None:
        """Give the device the bytes that have arrived by `now`, each at its own time."""
        while (arrives := self._inward.deadline) is not None and arrives <= now:
            self._listen(arrives)
            self._device.receive(self._inward.take(arrives), arrives)
        self._listen(now)

    def _listen(self, until: int) -> None:
        """Take the device's answers, each at the time at which it sends it."""
        while (due := self._device.deadline()) is not None and due <= until:
            self._outward.put(self._device.advance(due), due)
            if self._device.deadline() == due:
                break
        self._outward.put(self._device.advance(until), until)
