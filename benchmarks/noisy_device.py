"""A device behind a noisy line: bytes flipped, dropped, doubled and delayed both ways, seeded.

It is itself a device, so a run over it is the same every time. The probe is another line: looks
and power cycles are not affected.
"""

from __future__ import annotations

from collections import deque
from random import Random

from bilprov.analyzer.taps.impairment import Noise
from bilprov.captures.schemas import Look
from bilprov.conformance.dut.link import Device


class NoisyDevice:
    """A device behind a noisy line; `hurt` counts the chunks that the noise changed.

    Each byte takes `delay` ns in each direction, besides its time on the wire.
    """

    def __init__(self, device: Device, noise: Noise, seed: int, delay: int = 0) -> None:
        self._device = device
        self._noise = noise
        self._chance = Random(seed)
        self._delay = delay
        self._inward: deque[tuple[int, bytes]] = deque()  # (arrival in ns, bytes)
        self._outward: deque[tuple[int, bytes]] = deque()
        self.hurt = 0

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that enter the line at `now` (ns)."""
        arrived = self._through(data)
        if arrived:
            self._inward.append((now + self._delay, arrived))
            self._deliver(now)

    def advance(self, now: int) -> bytes:
        """Let time pass until `now` (ns); return the device's bytes that have come through."""
        self._deliver(now)
        self._listen(now)
        come = []
        while self._outward and self._outward[0][0] <= now:
            come.append(self._outward.popleft()[1])
        return b"".join(come)

    def deadline(self) -> int | None:
        """When (ns) bytes next arrive or the device acts by itself; None if it only waits."""
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
        """Give the device the bytes that have arrived by `now`, each chunk at its own time."""
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
