"""`bilprov cut`: a part of a capture is decoded as the whole is, and holds the bytes it held."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from bilprov.analyzer.api import read_capture
from bilprov.analyzer.cli.options import compiled
from bilprov.analyzer.decode.anomalies import UNCLEAR
from bilprov.analyzer.decode.batch import Records
from bilprov.analyzer.decode.json_lines import JsonLine, json_line
from bilprov.analyzer.decode.records import HostRecord, Record, is_frame
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.edit.cut import (
    edited_metadata,
    new_capture,
    write_selected,
    write_window,
)
from bilprov.analyzer.output.outputs import Window
from bilprov.analyzer.replay.capture_decoding import opened_at
from bilprov.captures.reader import open_capture, open_quickly
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.protocol import Protocol
from tests.support.captures import write_capture
from tests.support.decoding import Event
from tests.support.traffic import ACTS, SETTINGS, played

# A time-out of 0 is none that a capture can tell.
HOW = SETTINGS.map(lambda how: how | {"timeout": how["timeout"] or None})
START = 1_790_000_000_000_000_000
ALL = Window()
FEW = settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
FILTERS = [
    "faulty",
    "latency > 0.002",
    "direction == device",
    "kind == truncated",
    "kind == garbage or state.moving",
    "kind == response and not agrees",
    "kind == fault",
    "direction == host and t > 0.1",
    "t < 0",
]
SHARES = st.none() | st.tuples(st.integers(0, 3000), st.integers(0, 3000))
"""A window, in parts of the time that the events take."""


def written(path: Path, events: Sequence[Event], how: dict[str, Any]) -> Path:
    metadata = {
        "skew_ms": repr(how["skew"] / MS),
        "attached": "yes" if how["attached"] else "no",
        "heard": " ".join(how["heard"]),
    }
    if how["timeout"] is not None:
        metadata["truncation_timeout_ms"] = repr(how["timeout"] / MS)
    return write_capture(path, events, metadata, START)


def cut(
    path: Path, protocol: Protocol, window: Window = ALL, expression: str | None = None
) -> Path:
    """The part of a capture in a window, or what a filter selects of it."""
    out = path.with_name("cut.mcap")
    capture = open_capture(path)
    metadata = edited_metadata(capture, protocol, "cut")
    test = compiled(expression, protocol)
    with new_capture(out, [capture], metadata, protocol, bool, force=True) as copy:
        if test is None:
            opened = opened_at(open_quickly(path), protocol, window.first or 0)
            write_window(opened, window, copy)
        else:
            write_selected(lambda t: opened_at(open_quickly(path), protocol, t), window, test, copy)
    return out


def effective(events: Iterable[Event]) -> list[tuple[int, Event]]:
    """The events with the times that a decoder takes them at."""
    now, found = 0, []
    for event in events:
        now = max(now, event.t)
        found.append((now, event))
    return found


def seen(records: Iterable[Record]) -> list[Any]:
    """What people see of frames: times, bytes, numbers, judgements, states, latencies."""
    return [json_line(record) for record in records if is_frame(record)]


def is_unclear(record: Record) -> bool:
    return isinstance(record, HostRecord) and record.note == UNCLEAR


def window_of(events: Sequence[Event], shares: tuple[int, int] | None) -> Window:
    last = max((event.t for event in events), default=0)
    return Window(*sorted(last * share // 2500 for share in shares)) if shares else ALL


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.usefixtures("columns_at_once")
@FEW
@given(acts=ACTS, how=HOW, shares=SHARES)
def test_a_window_keeps_the_events_and_is_decoded_as_the_whole(
    each_protocol: Protocol,
    tmp_path: Path,
    acts: Any,
    how: dict[str, Any],
    shares: tuple[int, int] | None,
) -> None:
    events = [event for event in played(each_protocol, acts) if event.t >= 0]
    path = written(tmp_path / "a.mcap", events, how)
    window = window_of(events, shares)
    first = window.first or 0
    after = 1 << 62 if window.after is None else window.after
    part = cut(path, each_protocol, window)

    inside = [event for now, event in effective(events) if first <= now < after]
    kept = [event for event in open_capture(part).events() if not getattr(event, "silent", False)]
    # Where frame boundaries are looked for, the part begins before the window.
    earlier = [event for now, event in effective(events) if now < first]
    begin = max(
        at
        for at in range(min(len(kept), len(earlier)) + 1)
        if kept[:at] == earlier[len(earlier) - at :]
    )
    assert kept[begin : begin + len(inside)] == inside
    behind = [getattr(event, "event", "") for event in kept[begin + len(inside) :]]
    assert behind in ([], ["gap"])

    session = Session(each_protocol, **how)
    told: list[Record] = []
    for now, event in effective(events):
        if now < after:
            told += session.feed(event)
    # Bytes that are seen to be no frame only together cannot be seen to be none by half of them.
    assume(not any(is_unclear(record) and record.t < first <= record.end for record in told))
    expected = seen(record for record in told if last_byte(record) >= first)
    decoded = seen(r for r in read_capture(part, each_protocol) if last_byte(r) >= first)
    assert decoded[: len(expected)] == expected


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.usefixtures("columns_at_once")
@FEW
@given(acts=ACTS, how=HOW, shares=SHARES, expression=st.sampled_from(FILTERS))
def test_a_filtered_part_is_decoded_as_the_selected_frames_with_their_answers(
    each_protocol: Protocol,
    tmp_path: Path,
    acts: Any,
    how: dict[str, Any],
    shares: tuple[int, int] | None,
    expression: str,
) -> None:
    events = [event for event in played(each_protocol, acts) if event.t >= 0]
    path = written(tmp_path / "a.mcap", events, how)
    window = window_of(events, shares)
    part = cut(path, each_protocol, window, expression)

    whole = read_capture(path, each_protocol)
    expected = selected(whole, window, compiled(expression, each_protocol))
    decoded = seen(read_capture(part, each_protocol))
    assert in_order(expected, decoded)
    assert_whole_reads(path, part)


def assert_whole_reads(path: Path, part: Path) -> None:
    """What a part has of a capture are whole reads, none of which is there twice."""
    for side in ("host", "device"):
        kept, reads = (
            [e for e in open_capture(file).events() if is_read(e, side)] for file in (part, path)
        )
        assert in_order(kept, reads)


def in_order(wanted: Sequence[Any], found: Iterable[Any]) -> bool:
    """Whether all that is wanted is found, in that order."""
    rest = iter(found)
    return all(one in rest for one in wanted)


def is_read(event: Event, side: str) -> bool:
    return isinstance(event, Chunk) and event.direction == side


def last_byte(record: Record) -> int:
    return record.end if isinstance(record, HostRecord) else record.t


def selected(records: Iterable[Record], window: Window, test: Any) -> list[Any]:
    """The lines of the frames that a filter selects, each with its answer or instruction."""
    batch = Records(list(records))
    chosen = batch.in_order(test.selection(batch) & batch.inside(window.first, window.after))
    lines = [
        (line, one) for r, one in zip(batch.records(), chosen, strict=True) if (line := line_of(r))
    ]
    numbers = {number_of(line) for line, one in lines if one} - {None}
    return [line for line, one in lines if one or number_of(line) in numbers]


def line_of(record: Record) -> JsonLine | None:
    """The JSON line of a frame, None for another record."""
    return json_line(record) if is_frame(record) else None


def number_of(line: JsonLine) -> int | None:
    """The number of the instruction that a frame is, or answers."""
    return line.sequence if line.answers is None else line.answers
