"""A StreamDecoder gives the rows that one Session gives, however it is fed."""

from __future__ import annotations

from collections.abc import Sequence
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode import columns, pairing
from bilprov.analyzer.decode.batch import Batch, Kinds, Records
from bilprov.analyzer.decode.columns import ColumnBatch
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.codec import judge
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol, load
from tests.support.decoding import MS, Event
from tests.support.traffic import ACTS, BATCHES, SETTINGS, Acts, played, records_of, told

# Slow: more than make quick has time for.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("columns_at_once")]


def same(
    protocol: Protocol,
    events: Sequence[Event],
    batches: Sequence[int] = (1000,),
    looks: frozenset[int] = frozenset(),
    **chosen: Any,
) -> list[Any]:
    """The batches of a StreamDecoder, after comparing their rows with a Session's."""
    found = told(StreamDecoder(protocol, **chosen), events, batches, looks)

    assert records_of(found) == told(Session(protocol, **chosen), events, looks=looks)
    for batch in found:
        require_same(batch, Records(list(batch.records())))
    return found


HOST = ("t", "end", "known", "kind", "verdict", "sequence", "size", "header")
DEVICE = ("t", "byte", "sequence", "verdict", "agrees", "odd", "answering", "size", "address")


def require_same(batch: Batch, listed: Batch) -> None:
    """Hold the columns of a batch against those of the same rows decoded one by one."""
    for names, ones, others in (
        (HOST, batch.hosts, listed.hosts),
        (DEVICE, batch.devices, listed.devices),
    ):
        for name in names:
            assert getattr(ones, name).tolist() == getattr(others, name).tolist(), name
    answering = batch.devices.answering
    for name in ("header", "latency"):
        one, other = (getattr(each.devices, name)[answering] for each in (batch, listed))
        assert one.tolist() == other.tolist(), name
    for one, other in ((batch.hosts, listed.hosts), (batch.devices, listed.devices)):
        for variable in one.states.kind.variables:
            assert one.states[variable].tolist() == other.states[variable].tolist()
    assert [place.tolist() for place in batch.places] == [p.tolist() for p in listed.places]
    assert kinds(batch.hosts.faults) == kinds(listed.hosts.faults)
    assert kinds(batch.devices.faults) == kinds(listed.devices.faults)
    assert batch.counts == listed.counts
    rows = np.arange(len(batch)) % 3 == 1
    chosen = batch.selection(rows)
    assert batch.in_order(chosen).tolist() == rows.tolist()
    assert list(batch.records(chosen)) == list(listed.records(chosen))


def kinds(found: Kinds) -> list[tuple[str, ...]]:
    return [found.kinds[code] for code in found.code.tolist()]


SHIFTS = st.just([0]) | st.lists(
    st.sampled_from([0, 1000, MS, 5 * MS, 16 * MS, 19 * MS, 20 * MS, 25 * MS]),
    min_size=1,
    max_size=6,
)
"""How much (ns) too early a tap stamps the answers, over and over."""


@pytest.mark.sample(1)
@pytest.mark.slow
@given(ACTS, BATCHES, st.frozensets(st.integers(0, 60), max_size=5), SETTINGS, SHIFTS)
def test_columns_hold_the_records_of_a_session(
    each_protocol: Protocol,
    acts: Acts,
    batches: list[int],
    looks: frozenset[int],
    chosen: dict[str, Any],
    shifts: list[int],
) -> None:
    stamped = [
        replace_time(event, max(0, event.t - shifts[place % len(shifts)]))
        if isinstance(event, Chunk) and event.direction == "device" and any(shifts)
        else event
        for place, event in enumerate(played(each_protocol, acts))
    ]
    if any(shifts):
        stamped.sort(key=lambda event: event.t)

    same(each_protocol, stamped, batches, looks, **chosen)


def conversation(protocol: Protocol, count: int, seed: int) -> list[Event]:
    """Events of a host that waits for each answer, with random frames."""
    random, events = Random(seed), []
    for number in range(count):
        header = random.randrange(256)
        frame = bytes([header]) + random.randbytes(protocol.lengths[header])
        answer = bytes([judge(protocol, frame).response.code])
        events += [Chunk(number * MS, "host", frame), Chunk(number * MS + 1000, "device", answer)]
    return events


def test_early_answers_are_columns_too(protocol: Protocol) -> None:
    frame, ok = bytes([protocol.pad_byte]), bytes([protocol.answers[Outcome.VALID].code])
    events: list[Event] = []
    for turn in range(50):
        t = turn * 30 * MS
        events += [Chunk(t, "device", ok * 3), Chunk(t + MS, "host", frame * 5)]
        events.append(Chunk(t + 2 * MS, "device", ok * 2))

    parts = same(protocol, events)

    assert {type(batch) for batch in parts} == {ColumnBatch}


def test_traffic_without_oddities_is_columns_alone(each_protocol: Protocol) -> None:
    parts = same(each_protocol, conversation(each_protocol, 3000, 1), [700])

    assert {type(batch) for batch in parts} == {ColumnBatch}
    assert sum(batch.counts.frames for batch in parts) == 3000


@pytest.mark.parametrize("seed", range(3))
def test_one_oddity_leaves_the_rest_to_columns(each_protocol: Protocol, seed: int) -> None:
    events = conversation(each_protocol, 3000, seed)
    del events[1001]  # an answer
    later = [replace_time(event, event.t + 3000 * MS) for event in events[1001:]]

    parts = same(each_protocol, events[:1001] + later)

    odd = sum(len(batch) for batch in parts if isinstance(batch, Records))
    assert 0 < odd < 100


def test_a_silent_device_is_not_tried_as_columns_with_each_read(
    protocol: Protocol, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = []
    carry = columns.ColumnDecoder.carry
    monkeypatch.setattr(
        columns.ColumnDecoder, "carry", lambda *given: (tried.append(given), carry(*given))[1]
    )
    frame = bytes([protocol.pad_byte])

    same(protocol, [Chunk(turn * MS, "host", frame) for turn in range(3000)], [20])

    assert len(tried) < 20


# The answer's deadline, when it is given up, when a pause in a frame can cut it short: the ends.
LATE, LONGEST, SHORT, CUT = 100 * MS, 1000 * MS, 20 * MS, 50 * MS
ENDS = [end + more for end in (LATE, LONGEST, SHORT, CUT) for more in (-1, 0, 1)]


@pytest.mark.sample(3)
@pytest.mark.parametrize("pause", ENDS)
@pytest.mark.parametrize("skew", [0, 20 * MS])
@pytest.mark.parametrize("batches", [[1000], [1], [21, 2]], ids=str)
def test_at_the_ends_of_all_times_columns_hold_the_records_of_a_session(
    protocol: Protocol, pause: int, skew: int, batches: list[int]
) -> None:
    valid, faulty = bytes([protocol.pad_byte]), b"\x90"
    ok, wrong = (bytes([judge(protocol, frame).response.code]) for frame in (valid, faulty))
    two = protocol.lengths.index(1)
    frame = bytes([two, 0])
    answer = bytes([judge(protocol, frame).response.code])
    odd: list[list[tuple[int, str, bytes]]] = [
        [(0, "host", valid), (pause, "device", ok)],
        [(0, "host", valid), (pause, "host", valid), (0, "device", ok * 2)],
        [(0, "host", valid + faulty), (pause, "device", wrong)],
        [(0, "host", valid), (1, "host", faulty), (pause, "device", ok), (pause, "device", wrong)],
        [(0, "host", valid), (0, "device", ok + ok), (pause, "host", valid)],
        [(0, "host", frame[:1]), (pause, "host", frame[1:]), (0, "device", answer)],
        [(0, "host", frame[:1]), (pause, "device", answer), (0, "host", frame[1:])],
        [(0, "host", frame[:1]), (1, "device", answer), (pause, "host", frame[1:])],
        [(0, "host", valid + frame[:1]), (pause, "host", frame[1:]), (0, "device", ok + answer)],
        [(0, "host", valid + frame[:1]), (1, "device", ok), (pause, "host", frame[1:])],
    ]
    for acts in odd:
        t = 0
        events: list[Event] = conversation(protocol, 20, 1)
        for number in range(3):
            t += 3000 * MS
            for wait, side, data in acts:
                t += wait
                events.append(Chunk(t, side, data))  # type: ignore[arg-type]
            events += [Chunk(t + MS, "host", valid), Chunk(t + 2 * MS, "device", ok)] * (number < 2)
        same(protocol, events, batches, skew=skew)
        same(protocol, events, batches, frozenset(range(20, 40)), skew=skew)


def replace_time(event: Event, t: int) -> Event:
    return Chunk(t, event.direction, event.data) if isinstance(event, Chunk) else event


def test_frames_of_many_chunks_and_chunks_of_many_frames(each_protocol: Protocol) -> None:
    random = Random(3)
    stream = random.randbytes(150_000)
    events: list[Event] = []
    at = t = 0
    while at < len(stream):
        size = random.choice([1, 2, 7, 4096, 70_000])
        events.append(Chunk(t, "host", stream[at : at + size]))
        at, t = at + size, t + 1000

    same(each_protocol, events, [5, 1], heard=frozenset({"host"}))


@pytest.mark.parametrize("t", [-5, 1 << 61, (1 << 62) - 100 * MS, -(1 << 62)])
def test_times_that_fit_into_no_clock_are_decoded_all_the_same(protocol: Protocol, t: int) -> None:
    events = conversation(protocol, 50, 1)
    after = [replace_time(event, event.t + max(t, 0)) for event in events]

    same(protocol, [*events, Chunk(t, "host", b"\x11"), *after, Line(t, "gap"), *after], [7])


def test_a_grammar_whose_state_fits_into_no_column_is_decoded_by_a_session(
    grammar_text: str,
) -> None:
    text = grammar_text.replace('led=Bits("RGB")', f"led=Whole(0, {7 << 70})")
    huge = load(text.replace('led=From("rgb")', f'led=From("rgb", factor={1 << 70})'))

    parts = same(huge, conversation(huge, 300, 1))

    assert {type(batch) for batch in parts} == {Records}


@pytest.mark.parametrize("size", [1, 100])
def test_columns_give_up_as_a_session_does_where_a_million_have_one_time(
    protocol: Protocol, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pairing, "MOST", 500)
    monkeypatch.setattr(columns, "MOST", 500)
    flood = [Chunk(MS, "host", b"\x20" * size)] * (2000 // size)
    answers = [Chunk(MS, "device", b"\x00" * size)] * (1500 // size)

    parts = same(protocol, [*flood, *answers, *flood], (300,))
    same(protocol, [*answers, *flood, *answers], (300,))

    assert any(isinstance(batch, ColumnBatch) for batch in parts)
