"""A simulated drive to look at without a device: a host's seeded instructions, and the answers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from random import Random

from bilprov.analyzer.simulated.device import SimulatedDevice, drawn_request, faulty_request
from bilprov.analyzer.taps.sources import Events, Source
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.protocol import Protocol

_FAULTY = 0.1  # of the instructions
_PAUSES = 250, 1_200  # ms between instructions, as a person drives
_LATENCIES = 300, 3_000  # us until an answer
_MOVES = 4  # instructions after one that moves, before the host stops


def drive(protocol: Protocol, byte_time: int, seed: int = 1) -> Iterator[Chunk]:
    """Yield what a host and a conforming device send, without end; `byte_time` is ns a byte.

    The host sends valid requests and makes a mistake now and then; it stops a car that moves.
    """
    chance = Random(seed)
    device = SimulatedDevice(protocol)
    t, moving = 0, 0
    while True:
        t += chance.randint(*_PAUSES) * MS
        if moving > _MOVES:
            frame = bytes([protocol.pad_byte])
        elif chance.random() < _FAULTY:
            frame = faulty_request(protocol, chance)
        else:
            frame = drawn_request(protocol, chance)
        yield Chunk(t, "host", frame)
        t += len(frame) * byte_time
        device.receive(frame, t)
        answer = device.advance(t)
        moving = moving + 1 if protocol.wheels and protocol.directed(device.state()) else 0
        if answer:
            t += chance.randint(*_LATENCIES) * 1_000
            yield Chunk(t, "device", answer)
            t += len(answer) * byte_time


class SimulatedDrive(Source):
    """A source that opens no port: a simulated host drives a simulated device, in real time."""

    one_clock = True
    attached = False

    def __init__(self, protocol: Protocol, settings: LineSettings) -> None:
        super().__init__({})
        self.names = {"simulated": "drive" if protocol.wheels else protocol.device}
        self._chunks = drive(protocol, settings.byte_time)
        self._next = next(self._chunks)

    @property
    def ended(self) -> bool:
        """It never ends."""
        return False

    def _gather(self, events: Events, timeout_s: float | None, also: Sequence[int]) -> None:
        pause = max(0.0, (self._next.t - self.now()) / 1e9)
        self._ready(pause if timeout_s is None else min(pause, timeout_s), also)
        while self._next.t <= self.now():
            events.append(self._next)
            self._next = next(self._chunks)
        self.seen = self.now()  # nothing is missed where the program is late
