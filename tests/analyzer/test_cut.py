"""`bilprov cut`: a part of a capture is decoded as the whole is, and holds the bytes it held."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bilprov.analyzer.api import read_capture
from bilprov.analyzer.cli.options import compiled
from bilprov.analyzer.decode.json_lines import json_line
from bilprov.analyzer.decode.records import (
    HostRecord,
    Record,
    is_frame,
)
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.edit.cut import write_selected, write_window
from bilprov.analyzer.edit.new_capture import edited_metadata, new_capture
from bilprov.analyzer.output.outputs import Window
from bilprov.analyzer.replay.seek import opened_at
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.captures.writer import CaptureWriter
from bilprov.spec.protocol import Protocol
from tests.support.decoding import Event
from tests.support.traffic import ACTS, SETTINGS, played

# A time-out of 0 is none that a capture can tell.
HOW = SETTINGS.map(lambda how: how | {"timeout": how["timeout"] or None})
START = 1_790_000_000_000_000_000
ALL = Window()
QUICK = settings(
    max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)


def written(path: Path, events: Sequence[Event], how: dict[str, Any]) -> Path:
    path.unlink(missing_ok=True)
    metadata = {
        "skew_ms": repr(how["skew"] / MS),
        "attached": "yes" if how["attached"] else "no",
        "heard": " ".join(how["heard"]),
    }
    if how["timeout"] is not None:
        metadata["truncation_timeout_ms"] = repr(how["timeout"] / MS)
    with CaptureWriter(path, start_wall=START, metadata=metadata, version="1") as writer:
        for event in events:
            if isinstance(event, Chunk):
                writer.chunk(event)
            else:
                writer.write(event, event.t)
    return path


def cut(
    path: Path, protocol: Protocol, window: Window = ALL, expression: str | None = None
) -> Path:
    """The part of a capture in a window, or what a filter selects of it."""
    out = path.with_name("cut.mcap")
    capture = open_capture(path)
    metadata = edited_metadata(capture, protocol, "cut")
    test = compiled(expression, protocol)
    with new_capture(out, capture.start, metadata, force=True) as writer:
        if test is None:
            opened = opened_at(path, protocol, window.first or 0)
            write_window(opened, protocol, writer, window, lambda size: True)
        else:
            write_selected(
                lambda t: opened_at(path, protocol, t),
                protocol,
                writer,
                window,
                test,
                lambda size: True,
            )
    return out


def effective(events: Iterable[Event]) -> list[tuple[int, Event]]:
    """The events with the times that a decoder takes them at."""
    now, found = 0, []
    for event in events:
        now = max(now, event.t)
        found.append((now, event))
    return found


def seen(records: Iterable[Record]) -> list[object]:
    """What people see of frames: times, bytes, numbers, judgements, states, latencies."""
    return [json_line(record) for record in records if is_frame(record)]


@QUICK
@given(acts=ACTS, how=HOW, window=st.tuples(st.integers(0, 3000), st.integers(0, 3000)))
def test_a_window_keeps_the_events_and_is_decoded_as_the_whole(
    each_protocol: Protocol,
    tmp_path: Path,
    acts: Any,
    how: dict[str, Any],
    window: tuple[int, int],
) -> None:
    events = [event for event in played(each_protocol, acts) if event.t >= 0]
    path = written(tmp_path / "a.mcap", events, how)
    last = max((event.t for event in events), default=0)
    first, after = sorted(last * part // 2500 for part in window)
    part = cut(path, each_protocol, Window(first, after))

    inside = [event for now, event in effective(events) if first <= now < after]
    kept = [event for event in open_capture(part).events() if not getattr(event, "silent", False)]
    assert kept[: len(inside)] == inside
    assert [event.event for event in kept[len(inside) :] if isinstance(event, Line)] in (
        [],
        ["gap"],
    )
    assert not any(isinstance(event, Chunk) for event in kept[len(inside) :])

    session = Session(each_protocol, **how)
    told: list[Record] = []
    for now, event in effective(events):
        if now < after:
            told += session.feed(event)
    expected = seen(record for record in told if last_byte(record) >= first)
    decoded = seen(r for r in read_capture(part, each_protocol) if last_byte(r) >= first)
    assert decoded[: len(expected)] == expected


def last_byte(record: Record) -> int:
    return record.end if isinstance(record, HostRecord) else record.t


def selected(records: Iterable[Record], window: Window, test: Any) -> tuple[list[object], bool]:
    """The frames that a filter selects with their answers, and whether there may be others.

    Those are told by nothing but what came at the same moment, or in the same hunt.
    """
    told = list(records)
    exchanges: set[int] = set()
    alone: set[int] = set()
    loose = False
    for place, record in enumerate(told):
        line = json_line(record)
        if line is None or not window.has(record.t) or not test(line):
            continue
        number = line.sequence if line.answers is None else line.answers
        if number is not None:
            exchanges.add(number)
        else:
            alone.add(place)
            loose = True
    kept = [
        line
        for place, record in enumerate(told)
        if is_frame(record) and (line := json_line(record)) is not None
        if place in alone or {line.sequence, line.answers} & exchanges
    ]
    return kept, loose
