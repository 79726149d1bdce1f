"""Decoding of a byte stream into records, which depend on the times of the bytes alone."""

from __future__ import annotations

from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode.decoded_share import Checked, fitting_check
from bilprov.analyzer.decode.pairing import MOST, Waiting, waiting_frames
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS, Event, decoded, devices, hosts
from tests.support.traffic import ACTS, Acts, played


def drawn(protocol: Protocol, acts: Acts) -> list[Event]:
    """The events of some acts, by their times."""
    return sorted(played(protocol, acts), key=lambda event: event.t)


@given(ACTS, st.booleans())
def test_every_byte_is_in_one_record_in_order_and_each_instruction_has_one_answer_at_most(
    protocol: Protocol, acts: Acts, attached: bool
) -> None:
    events = drawn(protocol, acts)
    chunks = [event for event in events if isinstance(event, Chunk)]
    sent = b"".join(event.data for event in chunks if event.direction == "host")
    answered = [(e.t, byte) for e in chunks if e.direction == "device" for byte in e.data]

    records = decoded(Session(protocol, attached=attached), events)

    assert b"".join(record.data for record in hosts(records)) == sent
    assert b"".join(bytes.fromhex(record.value.hex) for record in hosts(records)) == sent
    assert [(record.value.t, record.value.byte) for record in devices(records)] == answered
    paired = [r.value.instruction for r in devices(records) if r.value.instruction is not None]
    assert paired == sorted(set(paired))
    cut: list[Event] = []  # bytes of one moment may be cut in any way
    for event in events:
        if isinstance(event, Chunk):
            cut += [Chunk(event.t, event.direction, bytes([byte])) for byte in event.data]
        else:
            cut.append(event)
    assert decoded(Session(protocol, attached=attached), cut) == records


@given(
    ACTS,
    st.lists(st.integers(0, 2000 * MS), max_size=20),
    st.sampled_from([0, 20 * MS]),
    st.booleans(),
)
def test_when_time_is_told_changes_no_record(
    protocol: Protocol,
    acts: Acts,
    looks: list[int],
    skew: int,
    attached: bool,
) -> None:
    events = drawn(protocol, acts)
    untold = decoded(Session(protocol, skew=skew, attached=attached), events)

    session = Session(protocol, skew=skew, attached=attached)
    told: list[Record] = []
    at = 0
    for event in events:
        for look in sorted(looks):
            if at <= look <= event.t:
                told += session.advance(look)
        told += session.feed(event)
        at = event.t
    told += session.finish()

    assert told == untold


@pytest.mark.parametrize("tap", ["host", "device", ""])
@pytest.mark.parametrize("begun", [b"", b"\x11"])
def test_answers_held_when_a_tap_is_unplugged_come_before_all_that_follows(
    protocol: Protocol, tap: Literal["host", "device", ""], begun: bytes
) -> None:
    events: list[Event] = [
        Chunk(0, "host", begun),
        Chunk(MS, "device", b"\x00\x01"),
        Line(2 * MS, "unplugged", tap),
        Chunk(3 * MS, "device", b"\x02"),
        Chunk(4 * MS, "host", b"\x20"),
    ]

    records = decoded(Session(protocol), events)

    assert [record.byte for record in devices(records)] == [0, 1, 2]
    assert b"".join(record.data for record in hosts(records)) == begun + b"\x20"


def test_at_a_known_beginning_or_after_silence_frames_come_out_at_once(protocol: Protocol) -> None:
    known, attached = Session(protocol), Session(protocol, attached=True)

    assert hosts(known.feed(Chunk(0, "host", b"\x20")))
    assert not hosts(attached.feed(Chunk(49 * MS, "host", b"\x20")))

    silent = Session(protocol, attached=True)
    assert hosts(silent.feed(Chunk(50 * MS, "host", b"\x20")))


def test_a_frame_that_is_unclear_comes_out_when_the_host_pauses(protocol: Protocol) -> None:
    session = Session(protocol, attached=True)

    assert session.feed(Chunk(10 * MS, "host", b"\x20")) == []
    assert session.deadline == 60 * MS
    assert session.advance(60 * MS - 1) == []

    (record,) = hosts(session.advance(60 * MS))
    assert (record.value.kind, record.value.t) == ("instruction", 10 * MS)


def test_the_last_byte_of_four_of_the_longest_frames_decides_what_was_unclear(
    protocol: Protocol,
) -> None:
    most = 4 * protocol.longest_frame
    # Every second byte looks like a frame, and every one like the data of another.
    unclear = bytes([0x41, 0x51]) * most
    session = Session(protocol, attached=True)

    assert session.feed(Chunk(0, "host", unclear[: most - 1])) == []
    found = hosts(session.feed(Chunk(0, "host", unclear[most - 1 :])))
    assert len(unclear) - sum(len(record.data) for record in found) < 2


# -- pairing of answers with instructions, and the anomalies that are reported ---------------------


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
