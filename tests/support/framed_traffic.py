"""Random traffic of a protocol whose frames have any layout, by seed: mostly regular, and odd."""

from __future__ import annotations

from contextlib import suppress
from random import Random
from typing import Any, NamedTuple

from bilprov.analyzer.simulated import device
from bilprov.captures.schemas import Chunk, Direction, Line
from bilprov.spec.codec import build, judge
from bilprov.spec.data import DataSpec
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import asked_values, build_reply
from tests.support import ROOT
from tests.support.decoding import MS, Event
from tests.support.drawn_layouts import drawn_fields

_LINES = ("break", "open", "parity", "gap", "overrun", "unplugged", "reconnected", "waited")


class Traffic(NamedTuple):
    """How traffic is drawn: the share of odd acts, the largest chunk, and how many ask at once."""

    odd: float = 0.1
    chunk: int = 300
    pipelined: int = 1


def exchanges(protocol: Protocol, random: Random, count: int, how: Traffic) -> list[Event]:
    """The events of so many exchanges, in the order of their times."""
    events: list[Event] = []
    t = 0
    while count > 0:
        t += random.choice([0, 1000, MS, 3 * MS])
        asked = [drawn_request(protocol, random) for _ in range(random.randint(1, how.pipelined))]
        count -= len(asked)
        told = [drawn_answer(protocol, random, one) for one in asked]
        sides: list[tuple[Direction, bytes]] = [
            ("host", b"".join(asked)),
            ("device", b"".join(told)),
        ]
        for direction, data in sides:
            if random.random() < how.odd:
                data, t = _odd(protocol, random, data, t, events)
            for part in _cut(random, data, how.chunk):
                events.append(Chunk(t, direction, part))
                t += random.choice([0, 0, 1000, MS])
    return events


def drawn_request(protocol: Protocol, random: Random) -> bytes:
    """A valid request to any address, sometimes to all."""
    asked = judge(protocol, device.drawn_request(protocol, random))
    assert asked.instruction
    values: dict[str, Any] = dict(asked.fields)
    for part in protocol.layout.parts:
        if part.role == "address":
            to = random.randint(part.low, part.high)
            values[part.name] = 0 if part.broadcast == 0 and random.random() < 0.05 else to
        if part.role == "other":
            values[part.name] = random.randint(0, part.most)
    return build(protocol, asked.instruction.name, values)


def drawn_answer(protocol: Protocol, random: Random, request: bytes) -> bytes:
    """The right answer to a request, with drawn data; b"" if none is due."""
    asked = judge(protocol, request)
    spec = (asked.instruction.answer if asked.instruction else None) or DataSpec()
    values = drawn_fields(random, spec)
    counted = spec.counted
    if counted and counted.expression and "size" not in {part.name for part in spec.fields}:
        # the request counts the last field
        size = int(asked_values(protocol, asked).get("size", 0))
        values[spec.fields[-1].name] = bytes(size)
    with suppress(OverflowError):  # more is asked for than the length of an answer can count
        return build_reply(protocol, asked, values)
    return b""


def _cut(random: Random, data: bytes, most: int) -> list[bytes]:
    parts = []
    while data:
        size = random.randint(1, most)
        parts.append(data[:size])
        data = data[size:]
    return parts


def _odd(
    protocol: Protocol, random: Random, data: bytes, t: int, events: list[Event]
) -> tuple[bytes, int]:
    """Something odd: before these bytes, or done to them."""
    what = random.randrange(8)
    if what == 0 and data:
        at = random.randrange(len(data))
        return data[:at] + bytes([data[at] ^ 1 << random.randrange(8)]) + data[at + 1 :], t
    if what == 1:
        at = random.randint(0, len(data))
        return data[:at] + data[at + 1 :], t
    if what == 2:
        at = random.randint(0, len(data))
        return data[:at] + random.randbytes(random.randint(1, 3)) + data[at:], t
    if what == 3:
        return data, t + random.choice([15, 20, 49, 50, 51, 99, 100, 101, 1000, 1100, 5001]) * MS
    if what == 4:
        events.append(Line(t, random.choice(_LINES), random.choice(["host", "device", ""])))
        return data, t
    if what == 5:
        return b"", t
    if what == 6:
        return data + data, t
    at = random.randint(0, len(data))
    events.append(Chunk(t, random.choice(["host", "device"]), data[:at]))
    return data[at:], t + random.choice([0, MS, 20 * MS, 60 * MS])


FRAMED = {
    name: (ROOT / folder / f"{name}.py").read_text(encoding="utf-8")
    for folder, names in (
        ("spec/grammars", ("modbus_rtu", "stk500v1", "dynamixel1")),
        ("examples", ("relay_board", "roboclaw")),
    )
    for name in names
}
"""The texts of the grammars, shipped ones and examples, whose frames are not the car's."""

READS_UNCHECKED = FRAMED["roboclaw"].replace(
    '        document="24 - Read Main',
    '        "channel" / Ranged(Byte, 1, 2) * "which battery",\n        document="24 - Read Main',
)
"""The motor controllers with a read that has data; the read is sent without a check."""
WITH_SYNC = READS_UNCHECKED.replace("FRAME = Struct(", 'FRAME = Struct(\n    Const(b"U"),').replace(
    "import Byte, Checksum,", "import Byte, Checksum, Const,"
)
"""The same with a fixed byte in front, which the check does not count."""


def odd_traffic(
    protocol: Protocol, seed: int = 1, count: int = 40, odd: float = 0.5
) -> list[Event]:
    """So many exchanges, a share of them damaged somehow, behind an answer nobody asked for.

    Two requests of each three wait for their answers together.
    """
    random = Random(seed)
    unasked = drawn_answer(protocol, random, drawn_request(protocol, random)) or b"\xff"
    how = Traffic(odd, pipelined=3)
    return [Chunk(0, "device", unasked), *exchanges(protocol, random, count, how)]
