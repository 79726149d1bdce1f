"""The pipeline: what is recorded, decoded, counted and shown does not depend on the batches."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bilprov.analyzer.decode.batch import Batch, Records
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.output.outputs import JsonText, Shown, StreamOutput, Window
from bilprov.analyzer.output.statistics import Rates, Statistics
from bilprov.analyzer.pipeline import Pipeline
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS, Event, conversation
from tests.support.traffic import ACTS, BATCHES, Act, played

pytestmark = pytest.mark.usefixtures("columns_at_once")

Counts = tuple[int, int, int, Rates]
"""Instructions, responses, faults, and the rates at the end."""

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
) -> tuple[str, Counts]:
    """What a pipeline shows as JSON lines, and what was counted in the end."""
    text: list[str] = []
    test = None if expression is None else compile_filter(expression, protocol)
    output = StreamOutput(text.append, JsonText())
    statistics = Statistics()
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
    return "".join(text), _counts(statistics, now)


@pytest.mark.slow
@settings(max_examples=30)
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

    text, counts = shown(protocol, events, batches, patience, **more)
    expected, one_by_one = shown(protocol, events, [1], 0, **more)
    assert text == expected
    assert counts[:3] == one_by_one[:3]  # a rate counts frames when they are decoded


@pytest.mark.slow
@settings(max_examples=30)
@given(ACTS, BATCHES)
def test_batches_are_counted_as_their_records_are(
    protocol: Protocol, acts: list[Act], batches: list[int]
) -> None:
    events = played(protocol, acts)
    _, counts = shown(protocol, events, batches)
    session, statistics = Session(protocol), Statistics()
    for event in events:
        _count(statistics, event, Records(session.feed(event)))
    statistics.batch(Records(session.finish()), 0)

    assert counts[:3] == _counts(statistics, 0)[:3]


def test_statistics_count_what_passed(protocol: Protocol) -> None:
    session, statistics = Session(protocol), Statistics()
    for event in conversation([(b"\x11\xff", b"\0"), (b"\x81\x09", b"\0"), (b"\x20", b"\0")]):
        _count(statistics, event, Records(session.feed(event)))

    assert (statistics.instructions, statistics.responses, statistics.faults) == (3, 3, 2)
    assert statistics.rates(200 * MS) == Rates(3 / 0.25, (5 / 0.25, 3 / 0.25))


def _count(statistics: Statistics, event: Event, batch: Batch) -> None:
    statistics.events([event])
    statistics.batch(batch, event.t)


def _counts(statistics: Statistics, now: int) -> Counts:
    counts = statistics.instructions, statistics.responses, statistics.faults
    return *counts, statistics.rates(now)
