"""A simulated drive to look at without a device: a host's seeded instructions, and the answers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from random import Random

from bilprov.analyzer.simulated.device import SimulatedDevice
from bilprov.analyzer.simulated.requests import drawn_request, with_wrong_end
from bilprov.analyzer.taps.sources import Events, Source
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.ports import wait_readable
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.codec import judge, raw_frame
from bilprov.spec.protocol import Protocol

_FAULTY = 0.1  # of the instructions
_PAUSES = 250, 1_200  # ms between instructions, as a person drives
_LATENCIES = 300, 3_000  # us until an answer
_MOVES = 4  # instructions after one that moves, before the host stops


def drive(protocol: Protocol, byte_time: int, seed: int = 1) -> Iterator[Chunk]:
    """Yield what a host and a conforming device send, without end; `byte_time` is ns a byte.

    The host sends valid instructions, stops now and then, and makes a mistake now and then.
    """
    chance = Random(seed)
    t, moving = 0, 0
    while True:
        t += chance.randint(*_PAUSES) * MS
        if moving > _MOVES:
            frame = bytes([protocol.pad_byte])
        elif chance.random() < _FAULTY:
            frame = _faulty_frame(protocol, chance)
        else:
            frame = _valid_frame(protocol, chance)
        judgement = judge(protocol, frame)
        known = judgement.instruction
        begins = known is not None and protocol.car.moves(known.effect)
        moving = 0 if frame[0] == protocol.pad_byte else moving + (begins or moving > 0)
        yield Chunk(t, "host", frame)
        t += len(frame) * byte_time + chance.randint(*_LATENCIES) * 1_000
        yield Chunk(t, "device", bytes([judgement.response.code]))


def exchanges(protocol: Protocol, byte_time: int, seed: int = 1) -> Iterator[Chunk]:
    """As `drive`, for a protocol whose header is not one byte."""
    chance = Random(seed)
    device = SimulatedDevice(protocol)
    t = 0
    while True:
        t += chance.randint(*_PAUSES) * MS
        frame = drawn_request(protocol, chance)
        if chance.random() < _FAULTY:
            frame = with_wrong_end(protocol, frame, chance)
        yield Chunk(t, "host", frame)
        t += len(frame) * byte_time
        device.receive(frame, t)
        answer = device.advance(t)
        if answer:
            t += chance.randint(*_LATENCIES) * 1_000
            yield Chunk(t, "device", answer)
            t += len(answer) * byte_time


def _valid_frame(protocol: Protocol, chance: Random) -> bytes:
    spec = chance.choice(protocol.instructions)
    data = b"".join(part.build(chance.randint(part.low, part.high)) for part in spec.fields)
    return raw_frame(protocol, spec.id, spec.length, data)


def _faulty_frame(protocol: Protocol, chance: Random) -> bytes:
    """A frame of any header with any data that is not valid."""
    while True:
        header = chance.randrange(len(protocol.headers))
        frame = bytes([header]) + chance.randbytes(protocol.lengths[header])
        if not judge(protocol, frame).valid:
            return frame


class SimulatedDrive(Source):
    """A source that opens no port: a simulated host drives a simulated device, in real time."""

    one_clock = True
    attached = False

    def __init__(self, protocol: Protocol, settings: LineSettings) -> None:
        super().__init__({})
        self.names = {"simulated": "drive"}
        made = drive if protocol.wheels else exchanges
        self._chunks = made(protocol, settings.byte_time)
        self._next = next(self._chunks)

    @property
    def ended(self) -> bool:
        """It never ends."""
        return False

    def _gather(self, events: Events, timeout_s: float | None, also: Sequence[int]) -> None:
        pause = max(0.0, (self._next.t - self.now()) / 1e9)
        wait_readable([], pause if timeout_s is None else min(pause, timeout_s), also)
        while self._next.t <= self.now():
            events.append(self._next)
            self._next = next(self._chunks)
