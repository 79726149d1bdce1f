"""Every way to look at a capture tells the same of it, frame by frame and oddity by oddity.

What one Session decodes, event by event, is held against the rows of `sniff`, `replay`, `browse`
and `export`, and against what `stats` counts.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bilprov.analyzer.decode.batch import Counts, Records
from bilprov.analyzer.decode.json_lines import encode, json_line
from bilprov.analyzer.decode.records import DeviceRecord, Record
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.export.rows import NoPyarrow, write_parquet, write_text
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.output.outputs import Shown, StreamOutput, Window, json_text, opened_output
from bilprov.analyzer.pipeline import BATCH, Pipeline
from bilprov.analyzer.replay.capture_decoding import (
    Opened,
    capture_decoder,
    capture_settings,
    capture_totals,
    opened_whole,
)
from bilprov.analyzer.screen.feeds import capture_feed
from bilprov.captures.reader import Capture, open_capture
from bilprov.spec.protocol import Protocol
from tests.analyzer.export.test_export import csv_rows, flat, parquet_rows, written, written_by
from tests.support import ROOT
from tests.support.decoding import MS, Event, capture_session, conversation, decoded
from tests.support.traffic import ACTS, BATCHES, SETTINGS, Acts, played

pytestmark = pytest.mark.usefixtures("columns_at_once")

SAMPLE = ROOT / "captures" / "samples" / "examples.mcap"
# Of a table: the values that JSON lines have too.
BESIDE = {"time", "t_ns", "latency_ns", "bytes"}


def json_rows(records: Iterable[Record]) -> list[dict[str, Any]]:
    return [json.loads(encode(line)) for record in records if (line := json_line(record))]


def sniffed(capture: Capture, protocol: Protocol) -> str:
    """The JSON lines of the events as they come, as `sniff` shows them."""
    text: list[str] = []
    decoder = StreamDecoder(protocol, **capture_settings(capture, protocol))
    shown = Shown(StreamOutput(text.append, json_text))
    pipeline = Pipeline(decoder, shown, patience=5 * MS)
    for event in capture.events():
        pipeline.events([event])
    pipeline.finish()
    return "".join(text)


def replayed(capture: Capture, protocol: Protocol) -> list[tuple[str, str, str]]:
    """Time, arrow, and what begins with the bytes, of the text lines of `replay` for frames."""
    text: list[str] = []
    output = opened_output("lines", protocol, write=text.append)
    for part in opened_whole(capture, protocol).decoded():
        output.show(part)
    lines = re.findall(r"^ *(-?[\d.]+) ([→←]|->|<-) (.*)$", "".join(text), re.M)
    return [(t, "host" if arrow in ("→", "->") else "device", rest) for t, arrow, rest in lines]


def browsed(capture: Capture, protocol: Protocol) -> list[Record]:
    """The rows of the screen."""
    opened = Opened(capture, capture_decoder(capture, protocol))
    feed = capture_feed(opened, protocol)
    feed.start()
    feed.join()
    return feed.recording.records(range(feed.recording.rows))


def require_agreement(path: Path, protocol: Protocol) -> None:
    """Look at a capture in every way, and compare."""
    capture = open_capture(path)
    records = decoded(capture_session(capture, protocol), capture.events())
    rows = json_rows(records)
    table = [flat(row) for row in rows]

    assert json_rows(browsed(capture, protocol)) == rows
    for text in (
        sniffed(capture, protocol),
        written_by(partial(write_text, style="jsonl"), capture, protocol),
    ):
        assert [json.loads(line) for line in text.splitlines()] == rows
    assert csv_rows(written_by(partial(write_text, style="csv"), capture, protocol)) == table
    try:
        typed = parquet_rows(written_by(write_parquet, capture, protocol))
    except NoPyarrow:
        typed = []
    for cells, row in zip(typed, table, strict=bool(typed)):
        told = {name: cell for name, cell in cells.items() if cell not in (None, "", [])}
        assert {name: told[name] for name in told.keys() - BESIDE} == row

    frames = [row for row in rows if row["hex"]]
    shown = replayed(capture, protocol)
    assert [(t, side) for t, side, _ in shown] == [
        (f"{row['t']:.6f}", row["direction"]) for row in frames
    ]
    assert all(rest.startswith(row["hex"]) for (*_, rest), row in zip(shown, frames, strict=True))

    totals = capture_totals(capture, protocol)
    kinds = Counter(row["kind"] for row in frames)
    assert kinds.pop("response", 0) == totals.device_bytes
    assert kinds == totals.kinds
    assert totals.faults_of() == Counter(fault for row in rows for fault in row["faults"])
    verdicts = Counter(row["agrees"] for row in rows)
    assert (totals.agreeing, totals.disagreeing) == (verdicts[True], verdicts[False])
    answers = [r for r in records if isinstance(r, DeviceRecord)]
    latencies = [r.latency for r in answers if r.latency is not None]
    spread = totals.latencies.spread()
    assert (spread and (spread.count, spread.min, spread.max)) == (
        (len(latencies), min(latencies), max(latencies)) if latencies else None
    )


def test_all_agree_on_the_sample(each_protocol: Protocol) -> None:
    require_agreement(SAMPLE, each_protocol)


@pytest.mark.sample(1)
@pytest.mark.slow
@settings(
    max_examples=8,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(ACTS, SETTINGS)
def test_all_agree_on_random_captures(
    each_protocol: Protocol, tmp_path: Path, acts: Acts, chosen: dict[str, Any]
) -> None:
    path = tmp_path / "a.mcap"
    path.unlink(missing_ok=True)
    events = sorted(played(each_protocol, acts), key=lambda event: event.t)
    require_agreement(written(path, events, chosen), each_protocol)


# -- the pipeline: what is recorded, decoded, counted and shown does not depend on the batches -----

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
    output = StreamOutput(text.append, json_text)
    pipeline = Pipeline(
        StreamDecoder(protocol),
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
    return "".join(text), pipeline.counts


@pytest.mark.parametrize("busy", [False, True])
def test_a_busy_line_is_decoded_ten_times_a_second(protocol: Protocol, busy: bool) -> None:
    text: list[str] = []
    shown = Shown(StreamOutput(text.append, json_text))
    pipeline = Pipeline(StreamDecoder(protocol), shown)
    pipeline.busy = busy
    first, answer = conversation([(b"\0", b"\0")], latency=50 * MS)
    pipeline.events([first])
    assert bool(text) is not busy
    pipeline.events([answer])
    assert bool(text) is not busy
    if busy:
        assert pipeline.deadline == first.t + BATCH
        pipeline.advance(first.t + BATCH - 1)
        assert not any(text)
        pipeline.advance(first.t + BATCH)
    lines = "".join(text).splitlines()
    assert [json.loads(line)["direction"] for line in lines] == ["host", "device"]


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
    acts: Acts,
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
    assert counts == one_by_one


@pytest.mark.slow
@settings(max_examples=30)
@given(ACTS, BATCHES)
def test_batches_are_counted_as_their_records_are(
    protocol: Protocol, acts: Acts, batches: list[int]
) -> None:
    events = played(protocol, acts)
    _, counts = shown(protocol, events, batches)
    session = Session(protocol)
    records = [record for event in events for record in session.feed(event)]

    assert counts == Records(records + session.finish()).counts
