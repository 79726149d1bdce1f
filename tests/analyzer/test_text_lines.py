"""Records as text lines and in the live view: safe, plain in a pipe, same values in both."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from bilprov.analyzer.columns.decoder import Records
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.output.live_view import View, live_view
from bilprov.analyzer.output.statistics import Snapshot, Statistics
from bilprov.analyzer.output.text_lines import LineRenderer
from bilprov.captures.schemas import Line
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS, conversation, decoded

TALK = [
    (b"\x11\xff", b"\0"),
    (b"\x20", b"\0"),
    (b"\x51\x60", b"\0"),
    (b"\x81\x05", b"\0"),
    (b"\x81\x09", b"\0"),
    (b"\x9f" + bytes(15), b"\1"),
    (b"\x20", b"\0"),
]


def _snapshot(protocol: Protocol, talk: list[tuple[bytes, bytes]] = TALK) -> Snapshot:
    session, statistics = Session(protocol), Statistics(protocol, 86_806)
    for event in conversation(talk):
        statistics.events([event])
        part = Records(session.feed(event))
        statistics.part(part, part)
    return statistics.snapshot(200 * MS)


def _drawn(view: View, width: int, height: int) -> Console:
    console = Console(
        width=width, height=height, record=True, file=io.StringIO(), force_terminal=True
    )
    console.print(live_view(view), height=height)
    return console


def test_a_line_tells_time_direction_bytes_words_and_state(protocol: Protocol) -> None:
    render = LineRenderer(colour=False)

    said, answered = (
        render.line(record) for record in decoded(Session(protocol), conversation(TALK[:1]))
    )

    assert said.split() == [
        *("0.020000", "→", "11", "ff", "Speed", "speed=255"),
        *("stopped", "speed", "255", "led", "0"),
    ]
    assert answered.split() == ["0.021000", "←", "00", "OK", "1.000", "ms"]


def test_a_faulty_frame_says_why(protocol: Protocol) -> None:
    render = LineRenderer(colour=False)

    said, answered = (
        render.line(record) for record in decoded(Session(protocol), conversation(TALK[4:5]))
    )

    assert "allowed are 0 to 7" in said
    assert "expected is BAD_DATA" in answered


def test_colour_codes_come_only_where_they_are_wanted(protocol: Protocol) -> None:
    records = decoded(Session(protocol), conversation(TALK))

    assert not any("\x1b" in LineRenderer(colour=False).line(record) for record in records)
    assert any("\x1b" in LineRenderer(colour=True).line(record) for record in records)


@given(st.text(max_size=300), st.text(max_size=300))
def test_foreign_text_is_made_safe(protocol: Protocol, event: str, detail: str) -> None:
    for line in (Line(0, event, "host", detail), Line(0, "break", "", detail)):
        (record,) = decoded(Session(protocol), [line])
        text = LineRenderer(colour=False).line(record)

        assert text.isprintable()
        assert len(text) < 500


@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 40), (200, 60), (40, 12), (20, 5)])
def test_the_live_view_fills_its_screen_and_no_more(
    protocol: Protocol, width: int, height: int
) -> None:
    view = View(protocol, _snapshot(protocol), "host /dev/a device /dev/b", "run.mcap 1 kB")

    text = _drawn(view, width, height).export_text()

    lines = text.rstrip("\n").split("\n")
    assert len(lines) <= height
    assert max(len(line) for line in lines) <= width


@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 40)])
def test_the_live_view_shows_frames_faults_numbers_and_the_car(
    protocol: Protocol, tmp_path: Path, width: int, height: int
) -> None:
    view = View(protocol, _snapshot(protocol), "host /dev/a device /dev/b", "run.mcap 1 kB")
    console = _drawn(view, width, height)

    text = console.export_text(clear=False)
    for word in (
        *("Speed speed=255", "LED rgb=5 (R B)", "disagreeing", "faulty instruction"),
        *("forward", "wheels +", "median", "B/s", "run.mcap", "● R", "○ G", "● B", "00:00.2"),
    ):
        assert word in text, text
    console.save_svg(str(tmp_path / "view.svg"), title="bilprov")
    assert ElementTree.parse(tmp_path / "view.svg").getroot().tag.endswith("svg")


def test_a_fresh_view_has_nothing_to_show_yet(protocol: Protocol) -> None:
    text = _drawn(View(protocol, _snapshot(protocol, []), "host /dev/a"), 80, 24).export_text()

    assert "none so far" in text
    assert "none yet" in text


def test_hostile_names_do_not_reach_the_screen(protocol: Protocol) -> None:
    snapshot = _snapshot(protocol)
    (record,) = decoded(Session(protocol), [Line(0, "[/x]\x1b[2J", "", "\u202e[/bold]")])
    view = View(
        protocol, replace(snapshot, recent=(record,)), "[/red]\x1b]0;x\x07", "\x9b2J[/blue]"
    )

    text = _drawn(view, 80, 24).export_text()

    assert all(line.isprintable() for line in text.split("\n"))
    assert "[/red]" in text


def test_statistics_count_what_passed(protocol: Protocol) -> None:
    snapshot = _snapshot(protocol)

    assert (snapshot.instructions, snapshot.responses) == (7, 7)
    assert (snapshot.host_bytes, snapshot.device_bytes) == (26, 7)
    assert dict(snapshot.faults) == {"faulty instruction": 2, "disagreeing": 1}
    assert snapshot.latencies is not None
    assert (snapshot.latencies.median, snapshot.latencies.longest) == (MS, MS)
    assert snapshot.byte_rates[0] == pytest.approx(26 / 0.25)
