"""A packed recording has the rows, the anomalies and the filtered rows of its records."""

from __future__ import annotations

from bisect import bisect_left
from threading import RLock
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode.batch import Batch, Records
from bilprov.analyzer.decode.records import serious_faults
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.screen import recording as recordings
from bilprov.analyzer.screen.recording import Recording, RowSet, View, packed
from bilprov.captures.schemas import Chunk
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS
from tests.support.decoding import conversation as exchanges
from tests.support.expressions import expressions
from tests.support.traffic import ACTS, BATCHES, SETTINGS, Acts, played, records_of, told

pytestmark = pytest.mark.usefixtures("columns_at_once")


def decoded(
    protocol: Protocol, acts: Acts, batches: list[int], chosen: dict[str, Any]
) -> list[Batch]:
    return told(StreamDecoder(protocol, **chosen), played(protocol, acts), batches)


def recorded(protocol: Protocol, batches: list[Batch]) -> Recording:
    recording = Recording(protocol)
    for batch in batches:
        recording.add(batch)
    return recording


@pytest.mark.sample(1)
@pytest.mark.slow
@given(acts=ACTS, batches=BATCHES, chosen=SETTINGS, together=st.sampled_from([1, 3, 1024]))
def test_rows_are_the_records_in_order(
    each_protocol: Protocol,
    acts: Acts,
    batches: list[int],
    chosen: dict[str, Any],
    together: int,
) -> None:
    given_batches = decoded(each_protocol, acts, batches, chosen)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recordings, "TOGETHER", together)
        recording = recorded(each_protocol, given_batches)

    records = records_of(given_batches)
    assert recording.rows == len(records)
    assert recording.records(range(len(records))) == records
    assert recording.records(range(1, len(records), 3)) == records[1::3]
    faulty = [row for row, record in enumerate(records) if serious_faults(record)]
    assert recording.faults.slice(0, len(records)) == faulty


@pytest.mark.sample(1)
@pytest.mark.slow
@given(data=st.data(), acts=ACTS, batches=BATCHES, chosen=SETTINGS)
def test_a_view_has_the_rows_whose_lines_pass(
    each_protocol: Protocol,
    data: st.DataObject,
    acts: Acts,
    batches: list[int],
    chosen: dict[str, Any],
) -> None:
    test = compile_filter(data.draw(expressions(each_protocol)), each_protocol)
    given_batches = decoded(each_protocol, acts, batches, chosen)
    recording = Recording(each_protocol)
    view = View(recording, test)
    for batch in given_batches:  # it grows while it is looked at
        recording.add(batch)
        if data.draw(st.booleans()):
            view.catch_up()
    view.catch_up()

    whole = Records(records_of(given_batches))
    count = len(whole)
    rows = np.flatnonzero(whole.in_order(test.selection(whole))).tolist()
    assert view.rows(0, count) == rows
    assert (view.count, view.seen) == (len(rows), count)
    faulty = [row for row in rows if row in set(recording.faults.slice(0, count))]
    at = data.draw(st.integers(0, count))
    assert view.fault(at, 1) == min((row for row in faulty if row > at), default=None)
    assert view.fault(at, -1) == max((row for row in faulty if row < at), default=None)
    assert view.position(at) == sum(row < at for row in rows)


def conversation(protocol: Protocol, count: int) -> list[Any]:
    events = []
    for at in range(count):
        frame = bytes([0x11, at & 255]) if at % 10 else b"\x11"
        events += [Chunk(at * 2000, "host", frame), Chunk(at * 2000 + 900, "device", b"\0")]
    return told(StreamDecoder(protocol), events, [512])


def test_a_packed_frame_with_its_answer_takes_few_bytes(protocol: Protocol) -> None:
    events = exchanges([(b"\x11\x05", b"\0")] * 20_000, MS, MS // 2)
    batches = told(StreamDecoder(protocol), events, [len(events)])

    for batch in (*batches, Records(records_of(batches))):
        assert len(packed(batch)) < 15 * len(batch) + 1000


def test_the_first_row_from_a_time_on_is_found_in_any_block(protocol: Protocol) -> None:
    events = exchanges([(b"\x11\x05", b"\0")] * 3000, MS, MS // 2)
    recording = recorded(protocol, told(StreamDecoder(protocol), events, [512]))
    times = [record.t for record in recording.records(range(recording.rows))]
    for row in (0, 1, 1500, 3001, recording.rows - 1):
        assert recording.row_at(times[row]) == bisect_left(times, times[row])
    assert recording.row_at(times[-1] + 1) == recording.rows


def test_the_oldest_rows_can_be_let_go(protocol: Protocol) -> None:
    recording = recorded(protocol, conversation(protocol, 3000))
    view = View(recording, compile_filter("direction == 'device'", protocol))
    view.catch_up()
    rows = view.rows(0, view.count)
    last = recording.records([recording.rows - 1])
    (some,) = recording.records([2500])
    took = recording.nbytes

    recording.let_go_older(some.t)

    assert 0 < recording.first <= 2500
    assert 0 < recording.nbytes < took
    assert recording.records([recording.first - 1]) == []
    assert recording.records([recording.rows - 1]) == last
    assert view.first == sum(row < recording.first for row in rows)
    assert View(recording).first == recording.first
    late = View(recording, view.test)
    late.catch_up()
    assert late.rows(late.first, late.count) == view.rows(view.first, view.count)
    assert view.fault(recording.first, -1) is None


def test_rows_that_go_while_a_filter_looks_are_none_of_its_rows(protocol: Protocol) -> None:
    recording = recorded(protocol, conversation(protocol, 3000))
    view = View(recording, compile_filter("direction == 'device'", protocol))
    whole = View(recording, view.test)
    whole.catch_up()

    while not view.catch_up(0):
        recording.let_go_oldest()
        recording.let_go_oldest()
    assert view.rows(view.first, view.count) == whole.rows(whole.first, whole.count)


def test_filtering_is_done_piece_by_piece(protocol: Protocol) -> None:
    recording = recorded(protocol, conversation(protocol, 3000))
    view = View(recording, compile_filter("faulty", protocol))

    assert not view.catch_up(0)
    assert 0 < view.seen < recording.rows


@given(
    masks=st.lists(st.lists(st.booleans() | st.just(False), max_size=40), max_size=8),
    others=st.lists(st.booleans(), max_size=200),
    row=st.integers(0, 330),
)
def test_a_row_set_counts_and_finds_as_a_list_does(
    masks: list[list[bool]], others: list[bool], row: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recordings, "PAGE", 16)
        lock = RLock()
        found, other = RowSet(lock), RowSet(lock)
        for mask in masks:
            found.append(np.array(mask, np.bool_))
        other.append(np.array(others, np.bool_))
        flat = [bit for mask in masks for bit in mask]
        members = [at for at, bit in enumerate(flat) if bit]
        both = [at for at in members if at < len(others) and others[at]]

        assert (found.rows, found.members) == (len(flat), len(members))
        assert found.before(row) == sum(at < row for at in members)
        assert found.slice(row % 7, row % 50) == members[row % 7 : row % 50]
        assert found.next(row) == min((at for at in members if at >= row), default=None)
        assert found.last(row) == max((at for at in members if at < row), default=None)
        assert found.next(row, other) == min((at for at in both if at >= row), default=None)
        assert found.last(row, other) == max((at for at in both if at < row), default=None)
