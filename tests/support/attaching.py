"""Simulates traffic between a host and a device as two taps hear it from some byte on."""

from __future__ import annotations

import random
from dataclasses import dataclass
from itertools import pairwise

from bilprov.captures.schemas import Chunk, Direction
from bilprov.spec.codec import build, judge, raw_frame
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS

BYTE = 86_806  # ns on a line of 115,200 baud
LATENCY_TIMER = 16 * MS  # of a USB adapter


@dataclass(frozen=True)
class Talk:
    """How host and device talk.

    `faulty` is the share of faulty frames; a host that pipelines does not wait for answers.
    `pause` (ns) is the host's between two frames, or between some. `timers` tells that both taps
    are USB adapters.
    """

    faulty: float = 0.02
    pipelined: bool = False
    pause: int = 5 * MS
    timers: bool = False


@dataclass(frozen=True)
class Heard:
    """What was heard: events, and at which host bytes true frames begin (the end included)."""

    events: list[Chunk]
    starts: frozenset[int]


def attached(protocol: Protocol, talk: Talk, rng: random.Random, frames: int = 60) -> Heard:
    """Attach just before a host byte that is picked at random, the first frames left out."""
    said, answers = _wire(protocol, talk, rng, frames)
    first = rng.randrange(10, len(said) // 3)
    began = rng.randrange(said[first - 1][0], said[first][0])
    starts = [at - first for at, (_, _, header) in enumerate(said) if header and at >= first]
    timed: list[tuple[int, Direction, int]] = []
    wires: list[tuple[Direction, list[tuple[int, int]]]] = [
        ("host", [(t, byte) for t, byte, _ in said[first:]]),
        ("device", [(t, byte) for t, byte in answers if t > began]),
    ]
    for direction, sent in wires:
        phase = rng.randrange(LATENCY_TIMER)
        for t, byte in sent:
            late = LATENCY_TIMER - (t - began + phase) % LATENCY_TIMER if talk.timers else 0
            timed.append((t - began + late, direction, byte))
    timed.sort(key=lambda item: item[0])
    events = [Chunk(t, direction, bytes([byte])) for t, direction, byte in timed]
    return Heard(events, frozenset([*starts, len(said) - first]))


def wrong_frames(spans: list[tuple[int, int]], heard: Heard) -> int:
    """How many of the frames, given as first byte and byte after the last, are none."""
    true = set(pairwise(sorted(heard.starts)))
    return sum(span not in true for span in spans)


def _wire(
    protocol: Protocol, talk: Talk, rng: random.Random, frames: int
) -> tuple[list[tuple[int, int, bool]], list[tuple[int, int]]]:
    """Host bytes as (time, byte, whether it is a header) and answers as (time, byte)."""
    said, answers = [], []
    now = answered = 0
    for _ in range(frames):
        frame = _faulty(protocol, rng) if rng.random() < talk.faulty else _valid(protocol, rng)
        for at, byte in enumerate(frame):
            now += BYTE
            said.append((now, byte, at == 0))
        answered = max(now, answered) + rng.randrange(MS // 10, MS) + BYTE
        answers.append((answered, judge(protocol, frame).response.code))
        if not talk.pipelined:
            now = answered
        if not talk.pipelined or rng.random() < 0.3:
            now += round(talk.pause * rng.uniform(0.5, 1.5))
    return said, answers


def _valid(protocol: Protocol, rng: random.Random) -> bytes:
    spec = rng.choice(protocol.instructions)
    values = {f.name: rng.choice([f.low, f.high, rng.randint(f.low, f.high)]) for f in spec.fields}
    return build(protocol, spec.name, values)


def _faulty(protocol: Protocol, rng: random.Random) -> bytes:
    """An unused ID, a wrong length, or data out of range."""
    length = rng.choice(protocol.data_lengths)
    data = rng.choice(
        [bytes(length), b"\xff" * length, rng.randbytes(length), rng.randbytes(length)]
    )
    kind = rng.randrange(4)
    if kind == 0:
        return raw_frame(protocol, rng.choice(protocol.unused_ids), length, data)
    while kind < 3:
        spec = rng.choice(protocol.instructions)
        if spec.length != length:
            return raw_frame(protocol, spec.id, length, data)
    ranged = [(s, f) for s in protocol.instructions for f in s.fields if f.high < 255]
    spec, part = rng.choice(ranged)
    return raw_frame(protocol, spec.id, spec.length, bytes([rng.randint(part.high + 1, 255)]))
