"""Requests and answers on one wire get the directions that they were sent in."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable
from contextlib import closing
from itertools import islice
from random import Random

import pytest

import bilprov
from bilprov.analyzer.decode.records import DeviceRecord
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.taps.half_duplex import HalfDuplex
from bilprov.analyzer.taps.sources import drive
from bilprov.analyzer.transport.port import open_pty
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol, load
from tests.analyzer.decode.test_foreign_traffic import TRAFFIC, events
from tests.support.framed_traffic import READS_UNCHECKED, Traffic, exchanges

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
def test_a_request_without_a_check_is_one_only_if_it_is_valid() -> None:
    """The first two bytes are the rest of another frame; the request begins behind them."""
    sent = [("host", "80 18"), ("host", "80 18 01"), ("device", "00 7c 34 9f")]
    data = [(side, byte) for side, text in sent for byte in bytes.fromhex(text)]
    chunks = [Chunk(at * 1000, "host", bytes([byte])) for at, (_, byte) in enumerate(data)]

    found = by_byte(told(load(READS_UNCHECKED), chunks))

    assert [(side, byte) for _, side, byte in found] == data


def test_a_tap_may_join_at_any_byte() -> None:
    chunks = list(events("sr_flowmeter_target_15liter_per_min"))
    wire = b"".join(chunk.data for chunk in chunks)
    third = sum(len(chunk.data) for chunk in chunks[:6])

    for at in range(0, third, 7):
        cut = by_byte(chunks)[at:]
        found = told(load_protocol("modbus-rtu"), [Chunk(t, "host", bytes([b])) for t, _, b in cut])
        assert len(by_byte(found)) == len(wire) - at
        assert by_byte(found)[third - at :] == cut[third - at :], at


@pytest.mark.waits
def test_the_library_listens_to_one_wire() -> None:
    chunks = list(events("sr_flowmeter_target_15liter_per_min"))[:2]
    heard = threading.Event()
    with open_pty() as wire:

        def keep_sending() -> None:
            while not heard.wait(0.3):  # opening a port throws away what was sent before
                for chunk in chunks:
                    os.write(wire.master, chunk.data)

        sender = threading.Thread(target=keep_sending)
        sender.start()
        try:
            with closing(
                bilprov.sniff(wire.name, half_duplex=True, protocol="modbus-rtu")
            ) as records:
                answer = next(one for one in records if isinstance(one, DeviceRecord))
        finally:
            heard.set()
            sender.join()
    assert answer.data == chunks[1].data
    assert answer.agrees
    with pytest.raises(ValueError, match="one wire has both directions: leave out b"):
        next(bilprov.sniff("a", "b", half_duplex=True))


# -- `bilprov sniff sim`: a drive to look at that no device makes ----------------------------------


BYTE_TIME = 86_805
FRAMES = 600


def test_each_frame_is_answered_as_a_conforming_device_does(
    protocol: Protocol, wide: Protocol
) -> None:
    for one in (protocol, wide):
        chunks = list(islice(drive(one, BYTE_TIME), 2 * FRAMES))
        judged = [judge(one, chunk.data) for chunk in chunks[::2]]

        assert [chunk.direction for chunk in chunks] == ["host", "device"] * FRAMES
        answers = [bytes([judgement.response.code]) for judgement in judged]
        assert [chunk.data for chunk in chunks[1::2]] == answers
        faulty = sum(not judgement.valid for judgement in judged)
        assert 0.02 < faulty / FRAMES < 0.2
        assert [c.t for c in chunks] == sorted(c.t for c in chunks)


def test_it_is_the_same_for_the_same_seed_and_another_for_another(protocol: Protocol) -> None:
    def said(seed: int) -> list[bytes]:
        return [chunk.data for chunk in islice(drive(protocol, BYTE_TIME, seed), 40)]

    assert said(1) == said(1) != said(2)


def test_the_host_stops_soon_after_it_has_set_the_robot_moving(protocol: Protocol) -> None:
    state = protocol.power_on
    moving, longest = 0, 0
    for chunk in islice(drive(protocol, BYTE_TIME), 0, 2 * FRAMES, 2):
        judged = judge(protocol, chunk.data)
        effect = judged.instruction.effect if judged.instruction else protocol.on_fault
        effect = effect if judged.valid else protocol.on_fault
        state = effect.apply(state, dict(judged.fields))
        moving = moving + 1 if protocol.directed(state) else 0
        longest = max(longest, moving)

    assert 1 < longest < 8
