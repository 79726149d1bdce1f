"""Synchronising: a stream joined in the middle is read from a known frame boundary on."""

from __future__ import annotations

import random

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import Chunk
from bilprov.spec.framing import Framed, Framer
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.synchronise import Synchroniser, traffic
from tests.support.attaching import Talk, attached, wrong_frames
from tests.support.decoding import MS, hosts
from tests.vectors import STREAMS, StreamVector

PAUSES = [1 * MS, 5 * MS, 30 * MS]
ATTACHES = 25  # for each pause


def _fed(protocol: Protocol, data: bytes, boundary: float = 0.75) -> Synchroniser:
    synchroniser = Synchroniser(traffic(protocol), boundary)
    for byte in data:
        synchroniser.byte(byte)
    return synchroniser


def test_an_anchor_speaks_for_the_place_where_it_falls(protocol: Protocol) -> None:
    within, between = _fed(protocol, b"\x11"), _fed(protocol, b"\x11")
    for _ in range(4):
        between.anchor(6)

    for synchroniser in (within, between):
        synchroniser.byte(0x20)
        synchroniser.byte(0x20)

    assert within.first_frame(0.5) == 0
    assert between.first_frame(0.5) == 1


def test_data_within_the_range_of_their_field_speak_for_the_frame(protocol: Protocol) -> None:
    within, outside = (_fed(protocol, bytes.fromhex(frame), 0.1) for frame in ("81 05", "81 85"))

    assert within.first_frame(0.5) == 0
    assert outside.first_frame(0.5) == 2


def test_padding_is_not_taken_for_so_many_instructions(protocol: Protocol) -> None:
    assert not _fed(protocol, bytes(6)).locked


@given(st.binary(max_size=80), st.floats(0.1, 0.9), st.lists(st.floats(1, 64), max_size=20))
def test_the_first_frame_lies_within_what_is_held(
    protocol: Protocol, data: bytes, boundary: float, anchors: list[float]
) -> None:
    synchroniser = _fed(protocol, data, boundary)
    for ratio in anchors:
        synchroniser.anchor(ratio)

    places = [synchroniser.first_frame(sure) for sure in (0.5, 0.99)]

    assert synchroniser.held == len(data)
    assert 0 <= places[0] <= places[1] <= len(data)


@given(st.binary(min_size=100, max_size=100))
@example(bytes(14) + b"\x09" + bytes(85))  # the 09 may be a header, or data: both go on at 24
def test_a_frame_begins_where_it_is_said_to_at_the_latest_when_locked(
    protocol: Protocol, data: bytes
) -> None:
    """Once locked, more bytes do not change where the next frames begin."""
    synchroniser = Synchroniser(traffic(protocol), 0.75)
    for byte in data[:50]:
        synchroniser.byte(byte)
    if not synchroniser.locked:
        return
    at = synchroniser.first_frame(1 - 1e-6)
    for byte in data[50:]:
        synchroniser.byte(byte)
    later = synchroniser.first_frame(1 - 1e-4)

    assert later in _starts(protocol, data, at) or at in _starts(protocol, data, later)


def _starts(protocol: Protocol, data: bytes, at: int) -> set[int]:
    """Where frames begin if one begins at `at`, the place behind the last one included."""
    starts = {at}
    while at < len(data):
        at += 1 + protocol.lengths[data[at]]
        starts.add(at)
    return starts


def test_another_split_of_the_header_is_followed(grammar_text: str) -> None:
    swapped = grammar_text.replace('"id" / BitsInteger(4)', '"id" / BitsInteger(5)')
    swapped = swapped.replace('"length" / BitsInteger(4)', '"length" / BitsInteger(3)')
    narrow = load(swapped, "narrow.py")

    # Speed's data, then Forward, LED, Speed, Stop: five bits say the ID, three the length.
    synchroniser = _fed(narrow, bytes.fromhex("7f 10 41 05 09 80 00 10 41 07"))

    assert synchroniser.locked
    assert synchroniser.first_frame(0.99) == 1


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("timers", [False, True], ids=["one-clock", "usb"])
@pytest.mark.parametrize(
    ("faulty", "pipelined", "median", "before", "after"),
    [
        (0.02, False, 8, 0.15, 0.03),
        (0.6, False, 40, 0.55, 0.06),
        (0.02, True, 10, 0.15, 0.03),
        (0.6, True, 48, 0.55, 0.06),
    ],
    ids=["normal", "faulty", "pipelined", "faulty-pipelined"],
)
def test_attaching_in_mid_stream_seldom_shows_a_frame_that_is_none(
    protocol: Protocol,
    faulty: float,
    pipelined: bool,
    median: int,
    before: float,
    after: float,
    timers: bool,
) -> None:
    """At most `after` of the attaches, where at least `before` do that take a byte for a header.

    The first frame comes out after a `median` of so many bytes. (Over 600 attaches, each measured:
    0 to 1.5 % instead of 28 to 79 %, after 4 to 34 bytes.)
    """
    rng = random.Random(f"{faulty} {pipelined} {timers}")
    wrong = {False: 0, True: 0}
    heard_until: list[int] = []
    for pause in PAUSES * ATTACHES:
        heard = attached(protocol, Talk(faulty, pipelined, pause, timers), rng, frames=80)
        for hunting in (False, True):
            session = Session(protocol, attached=hunting)
            spans, first = _frames(session, heard.events)
            wrong[hunting] += wrong_frames(spans, heard) > 0
            if hunting:
                heard_until.append(first)

    attaches = len(PAUSES) * ATTACHES
    assert wrong[False] >= before * attaches
    assert wrong[True] <= after * attaches
    assert sorted(heard_until)[attaches // 2] <= median
    assert max(heard_until) <= 5 * protocol.longest_frame


def _frames(session: Session, events: list[Chunk]) -> tuple[list[tuple[int, int]], int]:
    """Which bytes are shown as frames, and how many had been heard when the first one was."""
    spans: list[tuple[int, int]] = []
    at = heard = first = 0
    for event in [*events, None]:
        if event is not None and event.direction == "host":
            heard += len(event.data)
        for record in hosts(session.feed(event) if event else session.finish()):
            end = at + len(record.data)
            if record.value.kind == "instruction":
                spans.append((at, end))
                first = first or heard
            at = end
    return spans, first


# -- framing: every byte comes out once and in order, however the stream is cut or paused ----------


# Section 2: the last four bits of the header say how many data bytes follow.
LENGTHS = bytes(header & 0b1111 for header in range(256))
PROTOCOL = load_protocol()
TIMEOUT = 50

chunks = st.lists(st.tuples(st.binary(max_size=20), st.integers(0, 2 * TIMEOUT)), max_size=12)


def _all(
    chunks: list[tuple[bytes, int]], timeout: int | None, told: bool
) -> tuple[list[Framed], int]:
    """The records of chunks that each come some time after the one before, and the last time.

    The time is `told` before each chunk, or not.
    """
    framer, now = Framer(PROTOCOL, timeout), 0
    records: list[Framed] = []
    for data, pause in chunks:
        now += pause
        records += framer.advance(now) if told else []
        records += framer.feed(data, now)
    return [*records, *framer.drop(now, "truncated")], now


def _one_by_one(chunks: list[tuple[bytes, int]], timeout: int | None) -> list[bytes]:
    """The same frames, found the slow way: each byte with its time."""
    frames: list[bytes] = []
    now = last = missing = 0
    for data, pause in chunks:
        now += pause
        for byte in data:
            if missing and (timeout is None or now - last < timeout):
                frames[-1] += bytes([byte])
                missing -= 1
            else:
                frames.append(bytes([byte]))
                missing = byte & 0b1111
            last = now
    return frames


@given(chunks=chunks, timeout=st.sampled_from([None, 1, TIMEOUT]), told=st.booleans())
def test_the_frames_are_those_found_byte_by_byte_with_the_times_of_their_kind(
    chunks: list[tuple[bytes, int]], timeout: int | None, told: bool
) -> None:
    records, last = _all(chunks, timeout, told)

    assert [r.data for r in records] == _one_by_one(chunks, timeout)
    assert [r.start for r in records] == sorted(r.start for r in records)
    for index, record in enumerate(records):
        whole = len(record.data) == 1 + LENGTHS[record.data[0]]
        assert record.kind == ("instruction" if whole else "truncated")
        assert record.start <= record.end <= record.known
        if whole:
            assert record.known == record.end
        else:
            at_the_end = index == len(records) - 1 and record.known == last
            assert at_the_end or (timeout is not None and record.known == record.end + timeout)


@pytest.mark.parametrize("stream", STREAMS, ids=lambda s: f"{s.clause}: {s.title}")
def test_the_documents_examples_fall_into_their_frames(stream: StreamVector) -> None:
    framer = Framer(PROTOCOL, TIMEOUT)
    records = list(framer.feed(stream.data, 7))

    assert tuple(r.data for r in records) == stream.frames
    assert {r.kind for r in records} == {"instruction"}
    assert framer.held == stream.rest
