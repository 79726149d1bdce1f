"""Decoding of a byte stream into records, which depend on the times of the bytes alone."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, LineRecord, Record, Severity
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS, Event, conversation, decoded, devices, hosts, kinds

EVENTS = st.lists(
    st.tuples(
        st.sampled_from([0, 1, 1000, MS, 15 * MS, 40 * MS, 70 * MS, 1100 * MS]),
        st.one_of(
            st.tuples(st.just("host"), st.binary(min_size=1, max_size=20)),
            st.tuples(st.just("device"), st.binary(min_size=1, max_size=4)),
            st.tuples(st.sampled_from(["gap", "break", "open", "overrun"]), st.just(b"")),
        ),
    ),
    max_size=30,
)


def _events(drawn: Iterable[tuple[int, tuple[str, bytes]]]) -> list[Event]:
    events: list[Event] = []
    t = 0
    for pause, (what, data) in drawn:
        t += pause
        if what == "host":
            events.append(Chunk(t, "host", data))
        elif what == "device":
            events.append(Chunk(t, "device", data))
        else:
            events.append(Line(t, what))
    return events


@given(EVENTS, st.booleans())
def test_every_host_byte_is_in_exactly_one_record_in_order(
    protocol: Protocol, drawn: list[tuple[int, tuple[str, bytes]]], attached: bool
) -> None:
    events = _events(drawn)
    sent = b"".join(e.data for e in events if isinstance(e, Chunk) and e.direction == "host")

    records = hosts(decoded(Session(protocol, attached=attached), events))

    assert b"".join(record.data for record in records) == sent
    assert b"".join(bytes.fromhex(record.value.hex) for record in records) == sent


@given(EVENTS, st.booleans())
def test_every_device_byte_is_in_exactly_one_record(
    protocol: Protocol, drawn: list[tuple[int, tuple[str, bytes]]], attached: bool
) -> None:
    events = _events(drawn)
    answered = [
        (event.t, byte)
        for event in events
        if isinstance(event, Chunk) and event.direction == "device"
        for byte in event.data
    ]

    records = devices(decoded(Session(protocol, attached=attached), events))

    assert [(record.value.t, record.value.byte) for record in records] == answered


@given(
    EVENTS,
    st.lists(st.integers(0, 2000 * MS), max_size=20),
    st.sampled_from([0, 20 * MS]),
    st.booleans(),
)
def test_when_time_is_told_changes_no_record(
    protocol: Protocol,
    drawn: list[tuple[int, tuple[str, bytes]]],
    looks: list[int],
    skew: int,
    attached: bool,
) -> None:
    events = _events(drawn)
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


@given(EVENTS, st.booleans())
def test_bytes_of_one_moment_may_be_cut_in_any_way(
    protocol: Protocol, drawn: list[tuple[int, tuple[str, bytes]]], attached: bool
) -> None:
    events = _events(drawn)
    cut: list[Event] = []
    for event in events:
        if isinstance(event, Chunk):
            cut += [Chunk(event.t, event.direction, bytes([byte])) for byte in event.data]
        else:
            cut.append(event)

    whole = decoded(Session(protocol, attached=attached), events)
    assert decoded(Session(protocol, attached=attached), cut) == whole


@given(EVENTS)
def test_each_instruction_is_answered_at_most_once_and_in_order(
    protocol: Protocol, drawn: list[tuple[int, tuple[str, bytes]]]
) -> None:
    records = devices(decoded(Session(protocol), _events(drawn)))
    answered = [r.value.instruction for r in records if r.value.instruction is not None]

    assert answered == sorted(set(answered))


def test_the_predicted_state_stands_beside_every_frame(protocol: Protocol) -> None:
    talk = [(b"\x11\x7f", b"\0"), (b"\x20", b"\0"), (b"\x41\x40", b"\0"), (b"\x90", b"\1")]

    records = hosts(decoded(Session(protocol), conversation(talk)))

    states = [(r.state.motion, r.state.speed, r.state.steering, r.state.moving) for r in records]
    assert states == [
        ("stopped", 127, 0, False),
        ("forward", 127, 0, True),
        ("forward", 127, 64, True),
        ("stopped", 127, 0, False),
    ]


def test_a_frame_that_pauses_too_long_is_cut_short_with_what_arrived(protocol: Protocol) -> None:
    events = [Chunk(0, "host", b"\x11"), Chunk(51 * MS, "host", b"\x00")]

    first, second = hosts(decoded(Session(protocol), events))

    assert (first.value.kind, first.data, first.value.judgement) == (
        "truncated",
        b"\x11",
        "TOO_FEW_DATA",
    )
    assert (second.value.kind, second.data) == ("instruction", b"\x00")


def test_the_time_out_can_be_chosen(protocol: Protocol) -> None:
    events = [Chunk(0, "host", b"\x11"), Chunk(51 * MS, "host", b"\x00")]

    (record,) = hosts(decoded(Session(protocol, timeout=60 * MS), events))

    assert record.data == b"\x11\x00"


def test_lost_bytes_leave_the_frame_begun_as_garbage_and_the_next_byte_is_a_header(
    protocol: Protocol,
) -> None:
    events: list[Event] = [
        Chunk(0, "host", b"\x9f\x00\x00"),
        Line(MS, "gap", "host", "3 bytes"),
        Chunk(2 * MS, "host", b"\x20"),
    ]

    garbage, gap, frame = decoded(Session(protocol), events)

    assert isinstance(garbage, HostRecord)
    assert isinstance(gap, LineRecord)
    assert isinstance(frame, HostRecord)
    assert (garbage.value.kind, garbage.data) == ("garbage", b"\x9f\x00\x00")
    assert gap.lost
    assert frame.value.name == "Forward"


def test_lost_device_bytes_leave_the_host_frame_alone(protocol: Protocol) -> None:
    events: list[Event] = [
        Chunk(0, "host", b"\x11"),
        Line(MS, "gap", "device"),
        Chunk(2 * MS, "host", b"\x05"),
    ]

    (record,) = hosts(decoded(Session(protocol), events))

    assert record.data == b"\x11\x05"


def test_an_answer_in_mid_frame_and_then_silence_shows_that_framing_is_out_of_step(
    protocol: Protocol,
) -> None:
    # Attached in mid-frame: 0x11 is Speed's data, taken for a header.
    events = [
        Chunk(0, "host", b"\x11"),
        Chunk(MS, "device", b"\x00"),
        Chunk(30 * MS, "host", b"\x20"),
        Chunk(31 * MS, "device", b"\x00"),
    ]

    records = decoded(Session(protocol), events)

    assert [r.value.kind for r in hosts(records)] == ["garbage", "instruction"]
    assert [r.value.instruction for r in devices(records)] == [None, 0]
    assert "out of step" in kinds(records)


def test_a_device_with_less_patience_than_ours_answers_the_frame_cut_short(
    protocol: Protocol,
) -> None:
    events = [
        Chunk(0, "host", b"\x11"),
        Chunk(15 * MS, "device", b"\x04"),
        Chunk(40 * MS, "host", b"\x20"),
        Chunk(41 * MS, "device", b"\x00"),
    ]

    records = decoded(Session(protocol), events)

    assert [r.value.kind for r in hosts(records)] == ["truncated", "instruction"]
    assert [(r.value.instruction, r.value.agrees) for r in devices(records)] == [
        (0, True),
        (1, True),
    ]


@pytest.mark.parametrize("came", [1, 2])
def test_an_answer_at_a_header_that_is_already_wrong_is_no_loss_of_step(
    protocol: Protocol, came: int
) -> None:
    frame = b"\x92\x20\x00"  # its data look like headers
    events = [
        Chunk(0, "host", frame[:came]),
        Chunk(MS, "device", b"\x01"),
        Chunk(30 * MS, "host", frame[came:]),
    ]

    records = decoded(Session(protocol), events)

    assert [r.data for r in hosts(records)] == [frame]
    assert [r.value.instruction for r in devices(records)] == [0]


def test_ok_in_the_midst_of_a_frame_with_a_faulty_header_shows_it_too(protocol: Protocol) -> None:
    events = [
        Chunk(0, "host", b"\x9f"),
        Chunk(MS, "device", b"\x00"),
        Chunk(30 * MS, "host", b"\x20"),
        Chunk(31 * MS, "device", b"\x00"),
    ]

    records = decoded(Session(protocol), events)

    assert [r.value.kind for r in hosts(records)] == ["garbage", "instruction"]


@pytest.mark.parametrize("event", ["break", "parity", "framing", "overrun", "unplugged"])
def test_what_goes_wrong_on_a_line_is_a_fault(protocol: Protocol, event: str) -> None:
    records = decoded(Session(protocol), [Line(0, event, "host")])

    assert len(kinds(records)) == 1


@pytest.mark.parametrize("event", ["open", "close", "modem"])
def test_what_merely_happens_on_a_line_is_no_fault(protocol: Protocol, event: str) -> None:
    assert kinds(decoded(Session(protocol), [Line(0, event)])) == []


@pytest.mark.parametrize("side", ["host", "device"])
def test_one_direction_alone_is_not_paired(protocol: Protocol, side: str) -> None:
    events: list[Event] = [
        Chunk(0, "host", b"\x00"),
        Chunk(2000 * MS, "device", b"\x00"),
        Line(4000 * MS, "x"),
    ]
    heard = frozenset({side})

    records = decoded(Session(protocol, heard=heard), events)  # type: ignore[arg-type]

    assert kinds(records) == []


@pytest.mark.parametrize("tap", ["host", "device", ""])
def test_while_a_tap_is_unplugged_nothing_is_paired_or_missed(
    protocol: Protocol, tap: Literal["host", "device", ""]
) -> None:
    def exchange(at: int) -> list[Event]:
        return [Chunk(at * MS, "host", b"\x20"), Chunk((at + 1) * MS, "device", b"\x00")]

    events: list[Event] = [
        Chunk(0, "host", b"\x20"),
        Line(MS, "unplugged", tap),
        *exchange(2000)[tap == "host" :][: 2 - (tap == "device")],
        Line(4000 * MS, "reconnected", tap),
        *exchange(6000),
    ]

    records = decoded(Session(protocol), events)

    assert kinds(records) == ["unplugged", "lost bytes"]
    answers = [record for record in records if isinstance(record, DeviceRecord)]
    assert [answer.agrees for answer in answers][-1] is True
    assert not any(answer.agrees for answer in answers[:-1])


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


def test_an_event_from_the_past_counts_as_coming_with_the_last(protocol: Protocol) -> None:
    events = [Chunk(10 * MS, "host", b"\x11"), Chunk(5 * MS, "host", b"\x05")]

    (record,) = hosts(decoded(Session(protocol), events))

    assert (record.value.t, record.value.end) == (10 * MS, 10 * MS)


# Attached within a Speed; every frame is answered within a millisecond.
MID_STREAM: list[Event] = [
    *(Chunk(0, "host", b"\x7f"), Chunk(MS, "device", b"\x00")),
    *(Chunk(5 * MS, "host", b"\x20"), Chunk(6 * MS, "device", b"\x00")),
    *(Chunk(10 * MS, "host", b"\x81\x05"), Chunk(11 * MS, "device", b"\x00")),
    *(Chunk(15 * MS, "host", b"\x11\xff"), Chunk(16 * MS, "device", b"\x00")),
    *(Chunk(20 * MS, "host", b"\x30"), Chunk(21 * MS, "device", b"\x00")),
]


def test_attached_in_mid_frame_what_follows_is_shown_with_its_own_times(protocol: Protocol) -> None:
    records = hosts(decoded(Session(protocol, skew=0, attached=True), MID_STREAM))

    assert [(r.value.kind, r.data, r.value.t, r.value.end) for r in records] == [
        ("garbage", b"\x7f", 0, 0),
        ("instruction", b"\x20", 5 * MS, 5 * MS),
        ("instruction", b"\x81\x05", 10 * MS, 10 * MS),
        ("instruction", b"\x11\xff", 15 * MS, 15 * MS),
        ("instruction", b"\x30", 20 * MS, 20 * MS),
    ]


def test_answers_that_came_while_it_was_unclear_find_their_instructions(protocol: Protocol) -> None:
    records = devices(decoded(Session(protocol, skew=0, attached=True), MID_STREAM))

    assert [(r.value.instruction, r.value.agrees) for r in records] == [
        (None, None),
        (0, True),
        (1, True),
        (2, True),
        (3, True),
    ]
    assert records[0].faults[0].severity is Severity.INFO


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


def test_a_frame_that_is_unclear_comes_out_at_the_end(protocol: Protocol) -> None:
    events = [Chunk(0, "host", b"\x11\x07")]

    (record,) = hosts(decoded(Session(protocol, attached=True), events))

    assert (record.value.kind, record.data) == ("instruction", b"\x11\x07")


def test_no_more_than_four_of_the_longest_frames_are_held(protocol: Protocol) -> None:
    # Every second byte looks like a frame, and every one like the data of another.
    unclear = bytes([0x41, 0x51]) * protocol.longest_frame * 4

    session = Session(protocol, attached=True)
    records = hosts(session.feed(Chunk(0, "host", unclear)))

    held = len(unclear) - sum(len(record.data) for record in records)
    assert held < 2


def test_an_answer_before_the_first_host_byte_makes_it_likelier_a_header(
    protocol: Protocol,
) -> None:
    unlikely = Chunk(2 * MS, "host", b"\x90")  # a header of no instruction
    answer = Chunk(MS, "device", b"\x00")

    def kind(events: list[Event]) -> str:
        (record,) = hosts(decoded(Session(protocol, skew=0, attached=True), events))
        return record.value.kind

    assert kind([unlikely]) == "garbage"
    assert kind([answer, unlikely]) == "instruction"


def test_the_last_byte_of_four_of_the_longest_frames_decides_what_was_unclear(
    protocol: Protocol,
) -> None:
    most = 4 * protocol.longest_frame
    unclear = bytes([0x41, 0x51]) * most
    session = Session(protocol, attached=True)

    assert session.feed(Chunk(0, "host", unclear[: most - 1])) == []
    assert session.feed(Chunk(0, "host", unclear[most - 1 : most]))


def test_after_a_known_loss_the_rest_of_a_frame_is_not_taken_for_frames(protocol: Protocol) -> None:
    events: list[Event] = [
        Chunk(0, "host", b"\x20"),
        Line(MS, "gap", "host", "1 byte"),
        Chunk(2 * MS, "host", b"\x7f\x81\x05\x20\x41\xff\x00\x11\x07\x30\x81\x02"),
    ]

    records = hosts(decoded(Session(protocol), events))

    assert [r.data for r in records if r.value.kind == "garbage"] == [b"\x7f"]
    assert [r.data.hex() for r in records if r.value.kind == "instruction"] == [
        *("20", "8105", "20", "41ff", "00", "1107", "30", "8102")
    ]


def test_a_loss_while_it_is_unclear_decides_what_was_held(protocol: Protocol) -> None:
    events: list[Event] = [
        Chunk(0, "host", b"\x20"),
        Line(MS, "break", "host"),
        Line(2 * MS, "gap", "host"),
        Chunk(60 * MS, "host", b"\x30"),
    ]

    frame, broken, gap, last = decoded(Session(protocol, attached=True, skew=0), events)

    assert isinstance(frame, HostRecord)
    assert isinstance(broken, LineRecord)
    assert isinstance(gap, LineRecord)
    assert isinstance(last, HostRecord)
    assert (frame.data, last.data) == (b"\x20", b"\x30")


def test_another_grammar_is_followed(horn: Protocol) -> None:
    records = hosts(decoded(Session(horn), [Chunk(0, "host", b"\x91\x02\x91\x04")]))

    assert [(r.value.name, r.value.fields, r.value.judgement) for r in records] == [
        ("Horn", {"sound": 2}, "OK"),
        ("Horn", {"sound": 4}, "BAD_DATA"),
    ]


@pytest.mark.usefixtures("columns_at_once")
def test_columns_and_a_resumed_session_know_that_a_tap_is_unplugged(protocol: Protocol) -> None:
    said: list[Event] = [Chunk(n * 2000 * MS, "host", b"\x20" * 600) for n in range(1, 20)]
    gone = Line(MS, "unplugged", "device")
    columns, session = StreamDecoder(protocol), Session(protocol)
    session.feed(gone)
    state = session.saved()
    assert state is not None
    resumed = Session(protocol)
    resumed.resume(state)

    records = [record for part in columns.feed([gone, *said]) for record in part.records()]

    assert kinds(records) == ["unplugged"]
    assert kinds(decoded(resumed, said)) == []
