"""Decoding of a byte stream into records, which depend on the times of the bytes alone."""

from __future__ import annotations

from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.decode.session import Session
from bilprov.captures.schemas import Chunk, Line
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


@pytest.mark.parametrize(
    ("begun", "answer", "kinds", "pairs"),
    [
        (b"\x11", b"\x04", ["truncated", "instruction"], [(0, True), (1, True)]),
        (b"\x9f", b"\x00", ["garbage", "instruction"], [(None, None), (0, True)]),
    ],
)
def test_an_answer_in_the_midst_of_a_frame_shows_that_the_device_gave_it_up(
    protocol: Protocol, begun: bytes, answer: bytes, kinds: list[str], pairs: list[Any]
) -> None:
    events = [
        Chunk(0, "host", begun),
        Chunk(15 * MS, "device", answer),
        Chunk(40 * MS, "host", b"\x20"),
        Chunk(41 * MS, "device", b"\x00"),
    ]

    records = decoded(Session(protocol), events)

    assert [r.value.kind for r in hosts(records)] == kinds
    assert [(r.value.instruction, r.value.agrees) for r in devices(records)] == pairs


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
