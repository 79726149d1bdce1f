"""The reference device agrees with the hand-typed vectors and keeps the contract of a device."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.conformance.dut.simulator import Fault, Simulator, answers
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.spec.protocol import Protocol
from tests.vectors import (
    FRAMES,
    SEQUENCES,
    STREAMS,
    TIMING,
    FrameVector,
    RobotState,
    Sequence,
    StreamVector,
)

MS = 1_000_000
TIMEOUT = TIMING["truncation_timeout"] * MS


def shown(device: Simulator) -> RobotState:
    state = device.state
    return RobotState(str(state.motion), state.speed, state.steering, state.led, state.moving)


def cut_short(frame: bytes) -> bool:
    """Section 2: the low nibble is the number of data bytes."""
    return len(frame) - 1 < frame[0] & 0x0F


def exchange(device: Simulator, frame: bytes, now: int) -> tuple[bytes, int]:
    """Send a frame byte by byte, 1 ms apart; gives what came back in all, and the time."""
    said = b""
    for index in range(len(frame)):
        said += device.advance(now)
        device.receive(frame[index : index + 1], now)
        now += MS
    if cut_short(frame):
        now += TIMEOUT
    return said + device.advance(now), now


@pytest.mark.parametrize("vector", FRAMES, ids=lambda v: v.frame.hex())
def test_a_frame_gets_the_documents_answer_once(protocol: Protocol, vector: FrameVector) -> None:
    said, _ = exchange(Simulator(protocol), vector.frame, 0)

    assert said == bytes([vector.code])


@pytest.mark.parametrize("sequence", SEQUENCES, ids=lambda s: s.title)
def test_a_sequence_gives_the_answers_and_states_of_the_document_and_its_probe_what_it_does_now(
    protocol: Protocol, sequence: Sequence
) -> None:
    device, now = Simulator(protocol), 0
    for step in sequence.steps:
        said, now = exchange(device, step.frame, now)
        assert (said, shown(device)) == (bytes([step.code]), step.state)
        told = json.loads(device.probe(now))
        state = step.state
        assert set(told) == {"moving", "motion", "speed", "steering", "led", "left", "right"}
        assert told["moving"] is state.moving
        assert told["motion"] == (state.motion if state.moving else "stopped")
        assert (told["speed"], told["steering"], told["led"]) == state[1:4]
        assert (told["left"] == told["right"] == 0) is not state.moving


@pytest.mark.parametrize("stream", STREAMS, ids=lambda s: s.title)
def test_a_stream_without_pauses_is_answered_frame_by_frame(
    protocol: Protocol, stream: StreamVector
) -> None:
    device = Simulator(protocol)
    codes = {vector.frame: vector.code for vector in FRAMES}

    device.receive(stream.data, 0)

    said = device.advance(0)
    assert len(said) == len(stream.frames)
    for code, frame in zip(said, stream.frames, strict=True):
        assert code == codes.get(frame, code)
    assert (device.deadline() is None) is (stream.rest == b"")


@pytest.mark.parametrize("frame", ["11", "41", "81", "1f", "13 00 00", "91", "9f 00"])
def test_a_frame_that_pauses_is_cut_short_at_its_deadline_and_not_before(
    protocol: Protocol, frame: str
) -> None:
    device, sent = Simulator(protocol), bytes.fromhex(frame)
    device.receive(bytes.fromhex("11 c8 20"), 0)
    assert device.advance(0) == b"\0\0"
    for index in range(len(sent)):
        device.receive(sent[index : index + 1], index * 40 * MS)
    due = (len(sent) - 1) * 40 * MS + TIMEOUT

    assert device.deadline() == due
    assert device.advance(due - 1) == b""
    assert device.look(due - 1).moving
    assert device.advance(due) == bytes([1 if sent[0] >= 0x90 else 4])
    assert not device.look(due).moving
    assert device.deadline() is None


def test_bytes_that_come_after_the_deadline_begin_a_new_frame(protocol: Protocol) -> None:
    device = Simulator(protocol)
    device.receive(b"\x11", 0)

    device.receive(b"\x20", 10 * TIMEOUT)

    assert device.advance(10 * TIMEOUT) == bytes([4, 0])


@given(data=st.binary(max_size=60), cuts=st.lists(st.integers(0, 60), max_size=8))
def test_how_bytes_are_cut_into_chunks_changes_nothing(
    protocol: Protocol, data: bytes, cuts: list[int]
) -> None:
    whole, cut = Simulator(protocol), Simulator(protocol)

    whole.receive(data, 0)
    edges = [0, *sorted(min(c, len(data)) for c in cuts), len(data)]
    said = b""
    for start, end in pairwise(edges):
        cut.receive(data[start:end], 0)
        said += cut.advance(0)

    assert said == whole.advance(0)
    assert shown(cut) == shown(whole)
    assert cut.advance(TIMEOUT) == whole.advance(TIMEOUT)
    assert shown(cut) == shown(whole)


@given(data=st.binary(max_size=60))
def test_any_bytes_leave_it_in_a_state_that_the_protocol_has(
    protocol: Protocol, data: bytes
) -> None:
    device = Simulator(protocol)

    device.receive(data, 0)
    said = device.advance(TIMEOUT)

    assert set(said) <= set(range(5))
    assert 0 <= device.state.speed <= 255
    assert -255 <= device.state.steering <= 255
    assert 0 <= device.state.led <= 7


def test_a_latency_delays_the_answer_and_not_the_stop(protocol: Protocol) -> None:
    device = Simulator(protocol, latency=3 * MS)
    device.receive(bytes.fromhex("11 c8 20 90"), 0)

    assert not device.look(0).moving
    assert device.advance(3 * MS - 1) == b""
    assert device.deadline() == 3 * MS
    assert device.advance(3 * MS) == b"\0\0\1"


def test_answers_come_out_in_the_order_of_their_times(protocol: Protocol) -> None:
    slow = Fault("slow", "test", "valid ones late", react=lambda d, e, r: (
        answers(r, 0, delay=5 * MS) if e.judgement.valid else r
    ))  # fmt: skip
    device = Simulator(protocol, slow)

    device.receive(bytes.fromhex("00 90"), 0)

    assert device.advance(0) == b"\1"
    assert device.advance(5 * MS) == b"\0"


def test_a_state_that_comes_later_comes_at_its_time(protocol: Protocol) -> None:
    coasting = Fault("coasts", "test", "stops late", react=lambda d, e, r: (
        r if e.judgement.valid else replace(r, state=e.before, later=((7 * MS, r.state),))
    ))  # fmt: skip
    device = Simulator(protocol, coasting)
    device.receive(bytes.fromhex("11 c8 20 90"), MS)

    assert device.deadline() == MS
    assert device.advance(MS) == b"\0\0\1"
    assert device.deadline() == 8 * MS
    assert device.look(8 * MS - 1).moving
    assert not device.look(8 * MS).moving


def test_two_devices_of_one_fault_share_nothing(protocol: Protocol) -> None:
    fault = fault_bank(protocol)["restarts-on-next-valid"]
    one, other = Simulator(protocol, fault), Simulator(protocol, fault)
    one.receive(bytes.fromhex("11 c8 20 90"), 0)
    other.receive(bytes.fromhex("11 c8"), 0)

    other.receive(bytes.fromhex("81 01"), 0)

    assert not other.look(0).moving
