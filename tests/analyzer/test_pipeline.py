"""The pipeline: what is recorded, decoded, counted and shown does not depend on the batches."""

from __future__ import annotations

import sys
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bilprov.analyzer.columns.decoder import Part, Records, StreamDecoder
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.output.json_text import JsonText
from bilprov.analyzer.output.outputs import Shown, StreamOutput, Window
from bilprov.analyzer.output.statistics import Snapshot, Statistics
from bilprov.analyzer.pipeline import Pipeline
from bilprov.captures.schemas import Chunk
from bilprov.spec.codec import raw_frame
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS, Event
from tests.support.traffic import ACTS, BATCHES, Act, played

pytestmark = pytest.mark.usefixtures("columns_at_once")

FILTERS = [None, "faulty", "direction == device and not agrees", "state.moving or latency > 0.001"]


def shown(
    protocol: Protocol,
    events: list[Event],
    batches: list[int],
    patience: int = 0,
    *,
    expression: str | None = None,
    count: int | None = None,
    window: Window | None = None,
) -> tuple[str, Snapshot]:
    """What a pipeline shows as JSON lines, and the statistics in the end."""
    text: list[str] = []
    test = None if expression is None else compile_filter(expression, protocol)
    output = StreamOutput(text.append, JsonText())
    statistics = Statistics(protocol, 86_806)
    pipeline = Pipeline(
        StreamDecoder(protocol),
        statistics,
        Shown(output, test, count, window or Window()),
        patience=patience,
    )
    at = turn = now = 0
    while at < len(events):
        batch = events[at : at + batches[turn % len(batches)]]
        pipeline.events(batch)
        now = max(now, *(event.t for event in batch))
        pipeline.advance(now)
        at, turn = at + len(batch), turn + 1
    pipeline.finish()
    return "".join(text), statistics.snapshot(now)


@pytest.mark.slow
@settings(max_examples=80)
@given(
    ACTS,
    BATCHES,
    st.sampled_from([0, 5 * MS, 1000 * MS]),
    st.sampled_from(FILTERS),
    st.sampled_from([None, 1, 7]),
    st.sampled_from([None, 20 * MS]),
)
def test_what_is_shown_and_counted_does_not_depend_on_the_batches(
    protocol: Protocol,
    acts: list[Act],
    batches: list[int],
    patience: int,
    expression: str | None,
    count: int | None,
    first: int | None,
) -> None:
    events = played(protocol, acts)
    more: dict[str, Any] = {
        "expression": expression,
        "count": count,
        "window": Window(first, None if first is None else 3 * first),
    }

    text, snapshot = shown(protocol, events, batches, patience, **more)
    one_by_one, expected = shown(protocol, events, [1], 0, **more)

    assert text == one_by_one
    for name in Snapshot.__dataclass_fields__:
        if name != "recent_faults":  # of the moments when they were counted
            assert getattr(snapshot, name) == getattr(expected, name), name


@pytest.mark.slow
@settings(max_examples=80)
@given(ACTS, BATCHES)
def test_parts_are_counted_as_their_records_are(
    protocol: Protocol, acts: list[Act], batches: list[int]
) -> None:
    events = played(protocol, acts)
    _, snapshot = shown(protocol, events, batches)
    session, statistics = Session(protocol), Statistics(protocol, 86_806)
    for event in events:
        _count(statistics, event, Records(session.feed(event)))
    part = Records(session.finish())
    statistics.part(part, part)
    expected = statistics.snapshot(snapshot.t)

    for name in ("instructions", "responses", "faults", "latencies", "state", "recent"):
        assert getattr(snapshot, name) == getattr(expected, name), name
    assert set(snapshot.recent_faults) == set(expected.recent_faults)


def test_each_frame_of_a_part_counts_when_it_came(protocol: Protocol) -> None:
    stop = raw_frame(protocol, protocol.stop.id, 0)
    session, statistics = Session(protocol), Statistics(protocol, 86_806)
    frames = [Chunk(second * 1000 * MS, "host", stop) for second in range(10)]
    part = Records([record for event in frames for record in session.feed(event)])

    statistics.part(part, part)

    assert statistics.snapshot(9000 * MS).frame_rate == 1.0


def test_parts_of_which_a_filter_shows_nothing_are_not_kept(protocol: Protocol) -> None:
    statistics = Statistics(protocol, 86_806)
    empty = [Records([]) for _ in range(1000)]
    held = [sys.getrefcount(part) for part in empty]

    for part in empty:
        statistics.part(part, part)
    del part

    assert [sys.getrefcount(part) for part in empty] == held


def _count(statistics: Statistics, event: Event, part: Part) -> None:
    statistics.events([event])
    statistics.part(part, part)
