"""Seeded traffic for the bench: random frames of a grammar, a share of them faulty, and answers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice
from random import Random

from bilprov.captures.schemas import Chunk
from bilprov.spec.codec import judge
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol

FAULTY = 0.05  # share of the frames
_BLOCK = 20_000  # frames drawn at once; the share of faulty ones is exact in each block
_OF_A_HEADER = 256  # frames
_ANSWERED = 100_000  # ns from a read of the host's bytes to that of the device's

Exchange = tuple[bytes, bytes]
"""A frame and the answer of a conforming device."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """What a host and a conforming device have said: whole frames, and one answer byte for each."""

    host: bytes
    device: bytes

    @property
    def frames(self) -> int:
        """The number of frames."""
        return len(self.device)

    def first(self, protocol: Protocol, size: int) -> Traffic:
        """The first frames that have at least `size` host bytes together."""
        end = frames = 0
        while end < min(size, len(self.host)):
            end += 1 + protocol.lengths[self.host[end]]
            frames += 1
        return Traffic(self.host[:end], self.device[:frames])


def blocks(protocol: Protocol, seed: int, faulty: float = FAULTY) -> Iterator[list[Exchange]]:
    """Yield blocks of random exchanges without end; the same seed gives the same.

    `faulty` is the share of faulty frames. Each instruction is as likely as any other, and so is
    each outcome of a faulty frame.
    """
    draw = Random(seed)
    drawn = defaultdict[Outcome, list[Exchange]](list)
    for header, length in enumerate(protocol.lengths):
        for _ in range(_OF_A_HEADER):
            frame = bytes([header]) + draw.randbytes(length)
            judgement = judge(protocol, frame)
            drawn[judgement.outcome].append((frame, bytes([judgement.response.code])))
    valid, *faults = drawn.pop(Outcome.VALID), *drawn.values()
    while True:
        block = draw.choices(valid, k=_BLOCK)
        for place in draw.sample(range(_BLOCK), round(_BLOCK * faulty)):
            block[place] = draw.choice(draw.choice(faults))
        yield block


def traffic(protocol: Protocol, size: int, seed: int = 1) -> Traffic:
    """Traffic of at least `size` host bytes, in whole blocks."""
    host, device = bytearray(), bytearray()
    for block in blocks(protocol, seed):
        frames, answers = zip(*block, strict=True)
        host += b"".join(frames)
        device += b"".join(answers)
        if len(host) >= size:
            break
    return Traffic(bytes(host), bytes(device))


def reads(
    said: Traffic, protocol: Protocol, size: int, byte_time: int, start: int = 0
) -> Iterator[Chunk]:
    """Yield the traffic as it is read: `size` host bytes at a time, then their frames' answers.

    `byte_time` is how long a byte takes on the line, in ns; the line is never silent from `start`
    (ns) on.
    """
    lengths = protocol.lengths
    host, end, answered = said.host, 0, 0
    for at in range(0, len(host), size):
        last = min(at + size, len(host))
        t = start + last * byte_time
        yield Chunk(t, "host", host[at:last])
        before = answered
        while end < last and (after := end + 1 + lengths[host[end]]) <= last:
            end = after
            answered += 1
        if answered > before:
            yield Chunk(t + min(_ANSWERED, byte_time), "device", said.device[before:answered])


def waited(
    protocol: Protocol, frames: int, together: int = 1, pause: int = 20_000_000
) -> Iterator[Chunk]:
    """Yield the traffic of a host that waits for its answers, 2 % of its frames faulty.

    Each `pause` (ns) it sends so many frames `together`, which are answered together as well.
    """
    exchanges = islice(chain.from_iterable(blocks(protocol, 3, 0.02)), frames)
    t = 0
    while batch := list(islice(exchanges, together)):
        t += pause
        yield Chunk(t, "host", b"".join(frame for frame, _ in batch))
        yield Chunk(t + _ANSWERED, "device", b"".join(answer for _, answer in batch))
