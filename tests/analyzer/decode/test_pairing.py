"""Pairing of answers with instructions, and the anomalies that are reported."""

from __future__ import annotations

import pytest

from bilprov.analyzer.decode.decoded_share import Checked, fitting_check
from bilprov.analyzer.decode.pairing import MOST, Waiting, waiting_frames
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS, decoded, devices, hosts, kinds

# What the host says (ms), what the device answers, and to which instruction after how long (ms).
PAIRS: dict[str, tuple[list[tuple[int, str]], list[tuple[int, str]], list[tuple[int, int]]]] = {
    "the last byte counts": ([(0, "11"), (10, "05")], [(13, "00")], [(0, 3)]),
    "silence": ([(0, "20"), (2000, "00")], [(2001, "00")], [(1, 1)]),
    "a frame that is cut short may go unanswered": (
        [(0, "11"), (100, "20"), (110, "90")],
        [(101, "00"), (111, "01")],
        [(1, 1), (2, 1)],
    ),
    "codes tell that an answer is lost": ([(0, "20"), (200, "90")], [(201, "01")], [(1, 1)]),
}


@pytest.mark.parametrize("name", PAIRS)
def test_an_answer_is_paired_with_its_instruction(protocol: Protocol, name: str) -> None:
    said, answered, pairs = PAIRS[name]
    events = [Chunk(t * MS, "host", bytes.fromhex(data)) for t, data in said]
    events += [Chunk(t * MS, "device", bytes.fromhex(data)) for t, data in answered]

    records = decoded(Session(protocol), sorted(events, key=lambda event: event.t))

    assert [(r.value.instruction, (r.latency or 0) // MS) for r in devices(records)] == pairs
    assert all(record.value.agrees for record in devices(records))
    assert kinds(records).count("unanswered") == len(hosts(records)) - len(pairs)


@pytest.mark.slow
def test_of_a_flood_of_instructions_at_one_time_the_oldest_are_given_up(protocol: Protocol) -> None:
    session = Session(protocol)
    records = [r for _ in range(MOST // 64 + 1) for r in session.feed(host(b"\x20" * 64))]
    given_up = [fault for record in records for fault in record.faults]
    later = session.advance(5000 * MS)

    assert [fault.kind for fault in given_up] == ["unanswered"] * 64
    assert [fault.instruction for fault in given_up] == list(range(64))
    assert given_up[0].reason.endswith(f"in 0 ms, and {MOST} others wait")
    assert len(later) == MOST


@pytest.mark.slow
def test_of_a_flood_of_answers_at_one_time_the_oldest_are_given_up(protocol: Protocol) -> None:
    session = Session(protocol)
    session.feed(Chunk(0, "host", b"\x81"))  # an open frame, so that answers are held
    records = [r for _ in range(MOST + 10) for r in session.feed(Chunk(0, "device", b"\x05"))]

    assert len(devices(records)) == 10
    assert len(devices(session.finish())) == MOST


@pytest.mark.slow
def test_a_flood_of_answers_ends_the_search_for_frames(protocol: Protocol) -> None:
    session = Session(protocol, attached=True)
    session.feed(host(b"\x20"))
    records = [r for _ in range(1000) for r in session.feed(Chunk(0, "device", bytes(64)))]

    assert len(devices(records)) > 10_000


def test_after_bytes_were_lost_an_answer_is_that_of_no_frame_before(protocol: Protocol) -> None:
    events = [host(b"\x20"), Line(MS, "gap"), Chunk(2 * MS, "device", b"\x00")]

    records = decoded(Session(protocol), events)

    assert [record.value.instruction for record in devices(records)] == [None]


def host(data: bytes) -> Chunk:
    """Bytes of the host at time 0."""
    return Chunk(0, "host", data)


# -- what waits, as a checkpoint has it ------------------------------------------------------------


def waiting(protocol: Protocol, number: int, end: int, frame: bytes) -> Waiting:
    return Waiting(number, end, end + 1000 * MS, judge(protocol, frame))


def test_what_waits_is_put_together_by_its_times_as_far_as_a_frame_cut_short(
    protocol: Protocol,
) -> None:
    frames = [b"\x20", b"\x11\x05", b"\x11", b"\x20", b"\x20"]
    queue = [waiting(protocol, n, MS * (n > 3), frame) for n, frame in enumerate(frames)]

    groups = waiting_frames(queue)

    assert [group.frames for group in groups] == [b"\x20\x11\x05\x11", b"\x20", b"\x20"]
    assert [group.end for group in groups] == [0, 0, MS]


# -- near misses -----------------------------------------------------------------------------------


def test_one_frame_says_little_of_a_check_of_one_byte() -> None:
    layout = load_protocol("dynamixel1").layout
    frames = [Checked(bytes.fromhex(f"FFFF 0{to} 02 01 0{to + 3}")) for to in (1, 2)]
    negative = [Checked(frame[:-1] + bytes([-sum(frame[2:-1]) & 0xFF])) for frame, _ in frames]

    assert fitting_check(layout, frames[:1]) == ""
    assert fitting_check(layout, frames) == '"sum" / Checksum(Byte, Sum(8), this.covered.data)'
    assert "Checksum(Byte, Sum(8, complement=2), this" in fitting_check(layout, negative)
