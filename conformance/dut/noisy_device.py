"""A bad line around a device: bytes flipped, dropped, doubled and delayed both ways, seeded.

It is itself a device, so a run over it is the same every time. The probe is another line: looks
and power pass through it unharmed.
"""

from __future__ import annotations

from collections import deque
from random import Random

from analyzer.taps.noise import Noise
from captures.schemas import Look
from conformance.dut.link import Device

__all__ = ["Noise", "NoisyDevice"]


class NoisyDevice:
    """A device behind a bad line; `hurt` counts the pieces that came out otherwise than sent.

    Each byte takes `delay` ns in each direction, besides its time on the wire.
    """

    def __init__(self, device: Device, noise: Noise, seed: int, delay: int = 0) -> None:
        self._device = device
        self._noise = noise
        self._chance = Random(seed)
        self._delay = delay
        self._inward: deque[tuple[int, bytes]] = deque()  # when they arrive
        self._outward: deque[tuple[int, bytes]] = deque()
        self.hurt = 0

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that enter the line at `now` (ns)."""
        arrived = self._through(data)
        if arrived:
            self._inward.append((now + self._delay, arrived))
            self._deliver(now)

    def advance(self, now: int) -> bytes:
        """Let time pass until `now` (ns): what has come through of what the device sends."""
        self._deliver(now)
        self._listen(now)
        come = []
        while self._outward and self._outward[0][0] <= now:
            come.append(self._outward.popleft()[1])
        return b"".join(come)

    def deadline(self) -> int | None:
        """When something next arrives or the device acts by itself; None if it only waits."""
        first = (queue[0][0] for queue in (self._inward, self._outward) if queue)
        own = self._device.deadline()
        return min((*first, *(() if own is None else (own,))), default=None)

    def look(self, now: int) -> Look:
        """What the wheels and the LED do at `now` (ns)."""
        self._deliver(now)
        return self._device.look(now)

    def power_cycle(self, now: int) -> None:
        """Switch the device off and on at `now` (ns)."""
        power = getattr(self._device, "power_cycle")  # noqa: B009  # not every device has one
        power(now)

    def _deliver(self, now: int) -> None:
        """The device gets what has arrived by `now`, each piece at its own time."""
        while self._inward and self._inward[0][0] <= now:
            at, data = self._inward.popleft()
            self._listen(at)
            self._device.receive(data, at)

    def _listen(self, now: int) -> None:
        sent = self._device.advance(now)
        left = self._through(sent) if sent else sent
        if left:
            self._outward.append((now + self._delay, left))

    def _through(self, data: bytes) -> bytes:
        arrived = self._noise.over(data, self._chance)
        self.hurt += arrived != data
        return arrived
