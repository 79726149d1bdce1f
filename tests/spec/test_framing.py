"""Framing: every byte comes out once and in order, however the stream is cut or paused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.framing import Framed, Framer, Kind
from tests.vectors import STREAMS, StreamVector

# Section 2: the last four bits of the header say how many data bytes follow.
LENGTHS = bytes(header & 0b1111 for header in range(256))
PROTOCOL = load_protocol()
TIMEOUT = 50

chunks = st.lists(st.tuples(st.binary(max_size=20), st.integers(0, 2 * TIMEOUT)), max_size=12)


def _all(chunks: list[tuple[bytes, int]], timeout: int | None) -> tuple[list[Framed], int]:
    """The records of chunks that each come some time after the one before, and the last time."""
    framer, now = Framer(PROTOCOL, timeout), 0
    records: list[Framed] = []
    for data, pause in chunks:
        now += pause
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


@given(chunks=chunks, timeout=st.sampled_from([None, 1, TIMEOUT]))
def test_the_frames_are_those_found_byte_by_byte_with_the_times_of_their_kind(
    chunks: list[tuple[bytes, int]], timeout: int | None
) -> None:
    records, last = _all(chunks, timeout)

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


@given(data=st.binary(max_size=60), now=st.integers(0, 10**18))
def test_a_chunk_gives_the_same_records_whole_and_byte_by_byte(data: bytes, now: int) -> None:
    whole, cut = Framer(PROTOCOL, TIMEOUT), Framer(PROTOCOL, TIMEOUT)

    together = list(whole.feed(data, now))
    singly = [record for byte in data for record in cut.feed(bytes([byte]), now)]

    assert singly == together
    assert cut.held == whole.held
    assert cut.deadline == whole.deadline


@pytest.mark.parametrize("stream", STREAMS, ids=lambda s: f"{s.clause}: {s.title}")
def test_the_documents_examples_fall_into_their_frames(stream: StreamVector) -> None:
    framer = Framer(PROTOCOL, TIMEOUT)
    records = list(framer.feed(stream.data, 7))

    assert tuple(r.data for r in records) == stream.frames
    assert {r.kind for r in records} == {"instruction"}
    assert framer.held == stream.rest


FOREVER = 10**18
# What comes when (no bytes: time only passes), the time-out, and the records.
TIMES = {
    "cut at exactly the deadline": (
        [(100, b"\x42"), (149, b""), (150, b"")],
        TIMEOUT,
        [Framed("truncated", 100, 100, 150, b"\x42")],
    ),
    "counted from the last byte": (
        [(100, b"\x43\x01"), (149, b"\x02"), (198, b"\x03")],
        TIMEOUT,
        [Framed("instruction", 100, 198, 198, b"\x43\x01\x02\x03")],
    ),
    "a byte at the deadline is a header": (
        [(100, b"\x41"), (150, b"\x20")],
        TIMEOUT,
        [
            Framed("truncated", 100, 100, 150, b"\x41"),
            Framed("instruction", 150, 150, 150, b"\x20"),
        ],
    ),
    "known at the deadline however late one looks": (
        [(100, b"\x41"), (10_000, b"")],
        TIMEOUT,
        [Framed("truncated", 100, 100, 150, b"\x41")],
    ),
    "nothing is due between frames": (
        [(3, b"\x20"), (FOREVER, b"")],
        TIMEOUT,
        [Framed("instruction", 3, 3, 3, b"\x20")],
    ),
    "without a time-out it waits for ever": (
        [(0, b"\x41"), (FOREVER - 1, b""), (FOREVER, b"\x07")],
        None,
        [Framed("instruction", 0, FOREVER, FOREVER, b"\x41\x07")],
    ),
}


@pytest.mark.parametrize("case", TIMES)
def test_a_pause_of_the_time_out_ends_a_frame(case: str) -> None:
    steps, timeout, records = TIMES[case]
    framer = Framer(PROTOCOL, timeout)
    found: list[Framed] = []
    for now, data in steps:
        found += framer.feed(data, now) if data else framer.advance(now)

    assert found == records
    assert (framer.held, framer.missing, framer.deadline) == (b"", 0, None)


@pytest.mark.parametrize("kind", ["garbage", "truncated"])
def test_dropping_gives_up_the_frame_begun_and_the_next_byte_is_a_header(kind: Kind) -> None:
    framer = Framer(PROTOCOL, TIMEOUT)
    assert list(framer.feed(b"\x43\x01", 5)) == []
    assert framer.deadline == 5 + TIMEOUT

    assert framer.drop(9, kind) == [Framed(kind, 5, 5, 9, b"\x43\x01")]
    assert framer.drop(9) == []
    assert [record.data for record in framer.feed(b"\x20", 9)] == [b"\x20"]
