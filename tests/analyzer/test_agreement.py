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

from bilprov.analyzer.decode.json_lines import encode, json_line
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.export.rows import NoPyarrow, write_parquet, write_text
from bilprov.analyzer.output.outputs import JsonText, Shown, StreamOutput, stream_output
from bilprov.analyzer.output.statistics import Statistics
from bilprov.analyzer.pipeline import Pipeline
from bilprov.analyzer.replay.capture_decoding import (
    Opened,
    capture_decoder,
    capture_settings,
    capture_totals,
    opened_whole,
)
from bilprov.analyzer.screen.feeds import capture_feed
from bilprov.captures.reader import Capture, open_capture
from bilprov.captures.schemas import MS
from bilprov.spec.protocol import Protocol
from tests.analyzer.export.test_export import csv_rows, flat, parquet_rows, written, written_by
from tests.support import ROOT
from tests.support.decoding import capture_session, decoded
from tests.support.traffic import ACTS, SETTINGS, Act, played
from tests.support.wireshark import exported, packets

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
    shown = Shown(StreamOutput(text.append, JsonText()))
    pipeline = Pipeline(decoder, Statistics(), shown, patience=5 * MS)
    for event in capture.events():
        pipeline.events([event])
    pipeline.finish()
    return "".join(text)


def replayed(capture: Capture, protocol: Protocol) -> list[tuple[str, str, str]]:
    """Time, arrow, and what begins with the bytes, of the text lines of `replay` for frames."""
    text: list[str] = []
    output = stream_output("lines", protocol, text.append)
    for part in opened_whole(capture, protocol).decoded():
        output.show(part)
    lines = re.findall(r"^ *(-?[\d.]+) ([→←]|->|<-) (.*)$", "".join(text), re.M)
    return [(t, "host" if arrow in ("→", "->") else "device", rest) for t, arrow, rest in lines]


def browsed(capture: Capture, protocol: Protocol) -> list[Record]:
    """The rows of the screen."""
    opened = Opened(capture, capture_decoder(capture, protocol), capture.events)
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

    packed = [packet for packet in packets(exported(path, protocol)) if packet.data]
    for side, tap in enumerate((HostRecord, DeviceRecord)):
        mine = [r for r in records if isinstance(r, tap)]
        assert sorted(p.wall - capture.start for p in packed if p.interface == side) == sorted(
            r.end if isinstance(r, HostRecord) else r.t for r in mine
        )
        assert b"".join(p.data for p in packed if p.interface == side) == bytes.fromhex(
            "".join(r.hex for r in mine)
        )

    totals = capture_totals(capture, protocol)
    kinds = Counter(row["kind"] for row in frames)
    assert kinds.pop("response", 0) == totals.device_bytes
    assert kinds == totals.kinds
    assert totals.faults == Counter(fault for row in rows for fault in row["faults"])
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


@pytest.mark.slow
@settings(
    max_examples=8,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(ACTS, SETTINGS)
def test_all_agree_on_random_captures(
    each_protocol: Protocol, tmp_path: Path, acts: list[Act], chosen: dict[str, Any]
) -> None:
    path = tmp_path / "a.mcap"
    path.unlink(missing_ok=True)
    events = played(each_protocol, [act for act in acts if act.pause >= 0])
    require_agreement(written(path, events, chosen), each_protocol)
