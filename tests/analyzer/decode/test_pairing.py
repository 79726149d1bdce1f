"""Pairing of answers with instructions, and the anomalies that are reported."""

from __future__ import annotations

import pytest

from bilprov.analyzer.decode.pairing import MOST, Waiting, waiting_frames
from bilprov.analyzer.decode.records import Severity
from bilprov.analyzer.decode.session import Session
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS, Event, conversation, decoded, devices, hosts, kinds


def test_latency_counts_from_the_last_byte_of_the_instruction(protocol: Protocol) -> None:
    events = [
        Chunk(0, "host", b"\x11"),
        Chunk(10 * MS, "host", b"\x05"),
        Chunk(13 * MS, "device", b"\x00"),
    ]

    (record,) = devices(decoded(Session(protocol), events))

    assert record.value.latency == 3 * MS


def test_an_instruction_without_an_answer_is_reported_once(protocol: Protocol) -> None:
    events: list[Event] = [Chunk(0, "host", b"\x20"), Line(5000 * MS, "close")]

    records = decoded(Session(protocol), events)

    (fault,) = [fault for record in records for fault in record.faults]
    assert (fault.kind, fault.severity, fault.instruction) == ("unanswered", Severity.ERROR, 0)
    assert fault.t == 1000 * MS
    assert "Forward" in fault.reason


def test_after_silence_counting_begins_anew(protocol: Protocol) -> None:
    events = [
        Chunk(0, "host", b"\x20"),
        Chunk(2000 * MS, "host", b"\x00"),
        Chunk(2001 * MS, "device", b"\x00"),
    ]

    (record,) = devices(decoded(Session(protocol), events))

    assert record.value.instruction == 1


def test_an_answer_that_nothing_waits_for_is_unsolicited(protocol: Protocol) -> None:
    events = [*conversation([(b"\x20", b"\0\0")]), Line(500 * MS, "close")]

    records = decoded(Session(protocol), events)

    assert kinds(records) == ["unsolicited"]
    assert devices(records)[1].faults[0].severity is Severity.ERROR


def test_a_banner_before_the_first_instruction_is_only_noted(protocol: Protocol) -> None:
    records = decoded(Session(protocol), [Chunk(0, "device", b"\0"), Line(500 * MS, "close")])

    assert devices(records)[0].faults[0].severity is Severity.INFO


def test_ok_to_bad_data_disagrees_and_says_how(protocol: Protocol) -> None:
    records = decoded(Session(protocol), conversation([(b"\x81\x09", b"\0")]))

    (fault,) = devices(records)[0].faults
    assert (fault.kind, fault.severity) == ("disagreeing", Severity.ERROR)
    for word in ("OK", "BAD_DATA", "LED rgb=9", "0 to 7"):
        assert word in fault.reason


def test_another_code_for_a_fault_names_the_reading(protocol: Protocol) -> None:
    records = decoded(Session(protocol), conversation([(b"\x91\x00", b"\3")]))

    (fault,) = devices(records)[0].faults
    assert fault.severity is Severity.WARNING
    assert "R-unused-length" in fault.reason


def test_an_unused_code_is_an_error(protocol: Protocol) -> None:
    records = decoded(Session(protocol), conversation([(b"\x20", b"\x07")]))

    (record,) = devices(records)
    assert (record.value.name, record.value.agrees) == (None, False)
    assert kinds(records) == ["unused code"]


def test_an_answer_after_the_deadline_is_slow(protocol: Protocol) -> None:
    records = decoded(Session(protocol), conversation([(b"\x20", b"\0")], latency=101 * MS))

    assert kinds(records) == ["slow"]


def test_an_early_answer_comes_out_after_its_instruction(protocol: Protocol) -> None:
    events = [Chunk(0, "device", b"\x00"), Chunk(5 * MS, "host", b"\x20")]

    first, second = decoded(Session(protocol), events)

    assert ([first], [second]) == (hosts([first]), devices([second]))


def test_where_one_clock_hears_both_an_early_answer_is_the_devices_own(protocol: Protocol) -> None:
    events = [
        Chunk(0, "host", b"\x81"),
        Chunk(1 * MS, "device", b"\x00"),
        Chunk(2 * MS, "host", b"\x05"),
    ]

    records = decoded(Session(protocol, skew=0), events)

    (fault,) = devices(records)[0].faults
    assert (fault.kind, fault.severity) == ("early", Severity.WARNING)


def test_a_frame_cut_short_may_go_unanswered_without_shifting_the_rest(protocol: Protocol) -> None:
    events = [
        Chunk(0, "host", b"\x11"),
        Chunk(100 * MS, "host", b"\x20"),
        Chunk(101 * MS, "device", b"\x00"),
        Chunk(110 * MS, "host", b"\x90"),
        Chunk(111 * MS, "device", b"\x01"),
    ]

    records = decoded(Session(protocol), events)

    assert [(r.value.instruction, r.value.agrees) for r in devices(records)] == [
        (1, True),
        (2, True),
    ]
    assert "unanswered" in kinds(records)


def test_one_lost_answer_is_found_where_codes_tell(protocol: Protocol) -> None:
    events = [
        Chunk(0, "host", b"\x20"),  # its answer is lost
        Chunk(200 * MS, "host", b"\x90"),
        Chunk(201 * MS, "device", b"\x01"),
    ]

    (record,) = devices(decoded(Session(protocol), events))

    assert (record.value.instruction, record.value.agrees) == (1, True)


@pytest.mark.slow
def test_of_a_flood_of_instructions_at_one_time_the_oldest_are_given_up(
    protocol: Protocol,
) -> None:
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
