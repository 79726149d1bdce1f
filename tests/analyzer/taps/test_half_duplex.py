"""Requests and answers on one wire get the directions that they were sent in."""

from __future__ import annotations

from collections.abc import Iterable
from random import Random

import pytest

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.taps.half_duplex import HalfDuplex
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.protocol import Protocol
from tests.analyzer.decode.test_foreign_traffic import TRAFFIC, events
from tests.support.framed_traffic import Traffic, exchanges

TIMEOUT = 50 * MS


def told(protocol: Protocol, chunks: Iterable[Chunk]) -> list[Chunk]:
    """What the wire has, with the directions that are found."""
    wire = HalfDuplex(protocol, TIMEOUT)
    found = [one for chunk in chunks for one in wire.feed(chunk.data, chunk.t)]
    return found + wire.rest()


def by_byte(chunks: Iterable[Chunk]) -> list[tuple[int, str, int]]:
    return [(chunk.t, chunk.direction, byte) for chunk in chunks for byte in chunk.data]


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("name", list(TRAFFIC))
def test_recorded_traffic_is_told_apart(name: str, single: bool) -> None:
    grammar, _ = TRAFFIC[name]
    chunks = list(events(name, single=single))

    assert by_byte(told(load_protocol(grammar), chunks)) == by_byte(chunks)


@pytest.mark.parametrize("name", ["modbus-rtu", "dynamixel1", "examples/relay_board.py"])
def test_drawn_traffic_is_told_apart(name: str) -> None:
    protocol = load_protocol(name)
    chunks = [
        event
        for event in exchanges(protocol, Random(name), 300, Traffic(odd=0, chunk=7))
        if isinstance(event, Chunk)
    ]

    assert by_byte(told(protocol, chunks)) == by_byte(chunks)


@pytest.mark.slow
def test_a_tap_may_join_at_any_byte() -> None:
    chunks = list(events("sr_flowmeter_target_15liter_per_min"))
    wire = b"".join(chunk.data for chunk in chunks)
    third = sum(len(chunk.data) for chunk in chunks[:6])

    for at in range(third):
        cut = by_byte(chunks)[at:]
        found = told(load_protocol("modbus-rtu"), [Chunk(t, "host", bytes([b])) for t, _, b in cut])
        assert len(by_byte(found)) == len(wire) - at
        assert by_byte(found)[third - at :] == cut[third - at :], at
