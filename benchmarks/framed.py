"""Exchanges of published protocols to columns, both directions, beside construct alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from random import Random
from typing import Any, NamedTuple

from benchmarks.commands import medians, timed
from benchmarks.construct_alone import question
from benchmarks.decoding import Disagree
from benchmarks.report import CONSTRUCT, OURS, Row, times
from benchmarks.setting import Setting, Work
from bilprov.analyzer.decode.batch import Batch
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.events import Events
from bilprov.captures.schemas import Chunk
from bilprov.spec.codec import build, judge
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import build_reply

_DRAWN = 5000  # different exchanges
_PERIOD, _LATENCY = 20_000_000, 5_000_000  # ns
_GOAL = 150  # times construct


class Exchange(NamedTuple):
    """A request and its answer."""

    asked: bytes
    told: bytes


Drawn = tuple[str, dict[str, Any], dict[str, Any]]
"""A request's name, and the values of the request and of its answer."""


def _modbus(random: Random) -> Drawn:
    """Registers are read and written."""
    count = random.randint(1, 10)
    words = [random.randrange(1 << 16) for _ in range(count)]
    asked: dict[str, Any] = {"address": random.randint(1, 247), "start": random.randrange(1000)}
    match random.choices(("read", "write", "write many"), (8, 1, 1))[0]:
        case "read":
            name = random.choice(("ReadHoldingRegisters", "ReadInputRegisters"))
            return name, {**asked, "quantity": count}, {"values": words}
        case "write":
            asked = {"address": asked["address"], "register": asked["start"], "value": words[0]}
            return "WriteSingleRegister", asked, {}
    return "WriteMultipleRegisters", {**asked, "quantity": count, "values": words}, {}


def _dynamixel(random: Random) -> Drawn:
    """Servos are asked for their positions and sent to others."""
    count = random.randint(1, 8)
    data = random.randbytes(count)
    asked: dict[str, Any] = {"address": random.randint(0, 253), "register": random.randrange(50)}
    if random.random() < 0.5:
        return "Read", {**asked, "size": count}, {"values": data}
    return "Write", {**asked, "values": data}, {}


def _measured(setting: Setting, work: Work, *, name: str, draw: Callable[[Random], Drawn]) -> Row:
    protocol, random = load_protocol(name), Random(1)
    drawn: list[Exchange] = []
    for _ in range(_DRAWN):
        instruction, asked, told = draw(random)
        request = build(protocol, instruction, asked)
        drawn.append(Exchange(request, build_reply(protocol, judge(protocol, request), told)))
    size = sum(len(data) for one in drawn for data in one) / _DRAWN
    count = max(200, round(setting.sizes.columns / size))
    said = [drawn[place % _DRAWN] for place in range(count)]
    events = _events(said)
    sample = drawn[: max(50, round(setting.sizes.sample / size))]
    construct = _parser(protocol)
    works = {
        OURS: lambda: count / timed(lambda: _columns(protocol, events, count)),
        CONSTRUCT: lambda: len(sample) / timed(lambda: [construct(one) for one in sample]),
    }
    rates = medians(setting.sizes.rounds, works)
    words = f"{work.words}, {size * count / 1e6:.3g} MB"
    return work.row(words, "exchanges/s", rates, times(rates, CONSTRUCT, _GOAL))


modbus_rtu = partial(_measured, name="modbus-rtu", draw=_modbus)
dynamixel1 = partial(_measured, name="dynamixel1", draw=_dynamixel)


def _events(said: list[Exchange]) -> Events:
    """A host that waits for each answer."""
    events: list[Chunk] = []
    for number, one in enumerate(said):
        t = number * _PERIOD
        events += [Chunk(t, "host", one.asked), Chunk(t + _LATENCY, "device", one.told)]
    return Events.of(events)


def _columns(protocol: Protocol, events: Events, count: int) -> None:
    """Decode both sides to the end: verdicts, answers and latencies. Raises Disagree for less."""
    decoder = StreamDecoder(protocol)
    batches: list[Batch] = [*decoder.decode(events), *decoder.finish()]
    right = sum(int((batch.hosts.verdict == 0).sum()) for batch in batches)
    agreeing = sum(int((batch.devices.agrees == 1).sum()) for batch in batches)
    least = min(int(batch.devices.latency.min()) for batch in batches if len(batch.devices))
    if (right, agreeing, least) != (count, count, _LATENCY):
        raise Disagree(f"of {count} exchanges {right} requests and {agreeing} answers are right")


def _parser(protocol: Protocol) -> Callable[[Exchange], object]:
    """The grammar's own construct objects: a request and an answer, each parsed once."""
    space: dict[str, Any] = {"__name__": "grammar"}
    exec(compile(protocol.source, protocol.origin, "exec", dont_inherit=True), space)
    frame, reply = space["FRAME"], space["REPLY"]

    def parse(exchange: Exchange) -> object:
        return reply.parse(exchange.told, asked=question(frame, exchange.asked))

    return parse
