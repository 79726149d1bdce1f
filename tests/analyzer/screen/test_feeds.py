"""What the screen is fed with is bounded and told, and what it exports is a new file or none."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from random import Random
from typing import Any

import pytest

from bilprov.analyzer.decode.batch import Records
from bilprov.analyzer.decode.records import Record, is_frame
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.output.outputs import Window
from bilprov.analyzer.output.row_columns import RowStyle
from bilprov.analyzer.replay.capture_decoding import Opened, capture_decoder, opened_at
from bilprov.analyzer.replay.recorder import PARTS, Spool, session_metadata
from bilprov.analyzer.screen.feeds import AllShown, Feed, Rates, ScreenOutput, capture_feed
from bilprov.analyzer.screen.panes import figures, picture, status_line
from bilprov.analyzer.screen.recording import Recording, View, export
from bilprov.analyzer.totals.totals import Totals
from bilprov.captures.reader import open_capture, open_quickly
from bilprov.captures.schemas import Chunk
from bilprov.captures.writer import CaptureWriter
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.car import car_state
from tests.support.decoding import MS
from tests.support.robots import until
from tests.support.traffic import told

SAMPLE = ROOT / "captures" / "samples" / "examples.mcap"
MOST = PARTS << 16  # bytes of the spool


def fed(protocol: Protocol) -> Feed:
    return Feed(Recording(protocol), lambda feed: None, live=True)


def conversation(protocol: Protocol, count: int) -> list[Any]:
    events = []
    for at in range(count):
        events += [Chunk(at * MS, "host", b"\x11\x05"), Chunk(at * MS + MS // 2, "device", b"\0")]
    return told(StreamDecoder(protocol), events, [512])


def status_of(feed: Feed) -> str:
    return status_line("", feed, "", 120).plain


def test_rows_go_that_take_too_much_memory_and_it_is_said(protocol: Protocol) -> None:
    feed = fed(protocol)
    output = ScreenOutput(feed, most=20_000)
    for batch in conversation(protocol, 12_000):
        output.show(batch)
    assert (feed.recording.nbytes > 20_000, status_of(feed).split()[0]) == (True, "/")

    output.tick(0)

    assert feed.recording.nbytes <= 20_000
    (oldest,) = feed.recording.records([feed.recording.first])
    assert oldest.t > 0
    assert "no room for all rows: the oldest were dropped" in status_of(feed)


def test_rates_are_those_of_the_last_two_seconds(
    protocol: Protocol, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bilprov.analyzer.screen.feeds.DRAW_EVERY", 0)
    feed = fed(protocol)
    output = ScreenOutput(feed)
    first, *more = conversation(protocol, 1024)
    output.show(first)
    output.tick(256 * MS)
    assert feed.rates == (1000, [2000, 1000])
    for at in range(21):
        output.tick((500 + 100 * at) * MS)
    assert feed.rates == (0, [0, 0])
    for batch in more:
        output.show(batch)
    output.tick(2600 * MS)
    assert feed.rates == (768 / 2, [768, 768 / 2])


@pytest.mark.waits
def test_rows_go_that_a_spool_no_longer_has(
    protocol: Protocol, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    metadata = session_metadata(
        protocol, ports={"host": "a"}, line="115200 8N1", timeout=50 * MS, skew=0, heard=["host"]
    )
    feed, random, sent = fed(protocol), Random(1), 0
    with Spool(0, metadata, most=MOST) as spool:
        give_up = time.monotonic() + 20
        while not spool.oldest:
            assert time.monotonic() < give_up
            sent += 1
            spool.events([Chunk(sent * 3000 * MS, "host", random.randbytes(MOST // PARTS // 2))])
            spool.checkpoint(sent * 3000 * MS, lambda: None)
            time.sleep(0.01)
        assert spool.bytes < 12 * MOST  # a part grows by what waits to be written
        output = ScreenOutput(feed, spool)
        for batch in conversation(protocol, 12_000):
            output.show(batch)
        output.tick(0)
        assert (feed.keeps, feed.let_go) == (True, True)
        (oldest,) = feed.recording.records([feed.recording.first])
        assert 0 < oldest.t <= spool.oldest  # all that can be saved can be seen

        spool.failure = "the disk is full"
        ScreenOutput(feed, spool).tick(0)
        assert not feed.keeps


def test_the_screen_gets_what_a_filter_hides_and_nothing_outside_the_window(
    protocol: Protocol,
) -> None:
    feed = fed(protocol)
    test = compile_filter("direction == device", protocol)
    shown = AllShown(ScreenOutput(feed), test, 500, Window(10 * MS, 20 * MS))
    for batch in conversation(protocol, 1000):
        shown.show(batch)
    assert feed.recording.rows == 20
    assert shown.left == 490


def rows_of(protocol: Protocol, **limits: Any) -> list[Record]:
    """The rows that the screen has of the sample."""
    feed = capture_feed(opened_at(open_quickly(SAMPLE), protocol, 0), protocol, **limits)
    feed.start()
    feed.join()
    return feed.recording.records(range(feed.recording.rows))


def test_the_screen_has_all_of_a_capture_or_the_part_that_is_asked_for(protocol: Protocol) -> None:
    whole = rows_of(protocol)
    inside = rows_of(protocol, window=Window(5 * 10**8, 10**9))
    faulty = compile_filter("faulty", protocol).started(0)

    assert len(whole) == 84
    assert inside == [record for record in whole if 5 * 10**8 <= record.t < 10**9]
    assert 0 < len(inside) < len(whole)
    assert sum(map(is_frame, rows_of(protocol, count=5))) == 5
    first = rows_of(protocol, count=3, test=faulty)
    assert len(first) == 3
    assert faulty.selection(Records(first)).everything


def test_a_capture_that_is_still_written_is_followed_to_its_end(
    protocol: Protocol, tmp_path: Path
) -> None:
    path = tmp_path / "growing.mcap"
    van = {"grammar_name": "van", "grammar_sha256": "0" * 64}
    with CaptureWriter(path, start_wall=time.time_ns(), metadata=van, version="1") as writer:

        def written(first: int, stop: int) -> None:
            for at in range(first, stop):
                writer.chunk(Chunk(at * MS, "host", b"\x11\x05"))
                writer.chunk(Chunk(at * MS + MS // 2, "device", b"\0"))
            writer.flush()

        written(0, 10)
        capture = open_capture(path)
        feed = capture_feed(Opened(capture, capture_decoder(capture, protocol)), protocol)
        assert feed.live
        assert feed.notice.startswith("growing.mcap was recorded with another grammar (van)")
        feed.start()
        grew: list[Any] = []
        for count in (10, 50, 3000):
            written(feed.recording.rows // 2, count)
            until(lambda count=count: feed.recording.rows >= 2 * count)
            grew.append(feed.grew)
    assert grew[0] < grew[1] < grew[2]
    feed.join()  # the file is finished: nothing more can come
    capture = open_capture(path)
    whole = capture_feed(Opened(capture, capture_decoder(capture, protocol)), protocol)
    assert not whole.live
    whole.start()
    whole.join()
    rows = range(6000)
    assert feed.recording.records(rows) == whole.recording.records(rows)
    assert feed.recording.rows == whole.recording.rows == 6000


def recorded(protocol: Protocol, count: int) -> Recording:
    recording = Recording(protocol)
    for batch in conversation(protocol, count):
        recording.add(batch)
    return recording


def test_an_export_is_a_new_file_or_none(protocol: Protocol, tmp_path: Path) -> None:
    recording, path = recorded(protocol, 6000), tmp_path / "out.csv"
    view = View(recording)
    stopped = export(recording, view, str(path), RowStyle(), 0)
    assert 0 < next(stopped) < 6000
    stopped.close()
    assert list(tmp_path.iterdir()) == []

    path.write_text("precious")
    with pytest.raises(FileExistsError):
        list(export(recording, view, str(path), RowStyle(), 0))
    assert path.read_text() == "precious"
    with pytest.raises(OSError, match="/proc/"):
        list(export(recording, view, "/proc/out.jsonl", RowStyle(), 0))


def test_figures_tell_the_load_and_whose_the_faults_are(protocol: Protocol) -> None:
    totals = recorded(protocol, 3001).totals
    lines = [line.plain for line in figures(totals, None, 86_805, 27)]
    assert lines == [
        "███▁",
        "3,001 frames",
        "3,001 answers",
        "1,000 frames/s, 17% full",
        "latency 0.5 ms",
        "p95 0.5, max 0.5 ms",
        "",
        "Speed       3,001    0.5 ms",
    ]
    for frame in (b"\x90", b"\x91\x02"):
        (batch,) = told(StreamDecoder(protocol), [Chunk(0, "host", frame)], [1])
        totals.add(batch)
    lines = [line.plain for line in figures(totals, None, 86_805, 18)]
    assert lines[7:9] == ["! 2 from the host", "  faulty instruction: 2"]
    assert lines[-2:] == ["S… 3,001    0.5 ms", "u…     2          "]


def test_a_count_and_a_short_latency_stand_apart_and_one_frame_is_no_plural(
    protocol: Protocol,
) -> None:
    totals = Totals(protocol)
    events = [
        Chunk(at, "host" if at % 2 else "device", b"\x90" if at % 2 else b"\1")
        for at in (1, 86_902, 1_000_000_001, 1_000_086_902)
    ]
    for batch in told(StreamDecoder(protocol), events, [len(events)]):
        totals.add(batch)
    lines = [line.plain for line in figures(totals, Rates(1, (1, 1)), 86_805, 27)]
    assert "1 frame/s, 0% full" in lines
    assert lines[-1].endswith(" 2 0.0869 ms")


def test_the_car_turns_and_lights_as_its_state_says(protocol: Protocol) -> None:
    state = car_state("forward", 255, 255, 0b100)
    front, body, _, words, wheels, speed, steering, led = (
        line.plain for line in picture(protocol, state)
    )
    left, right = front.split("┌───────┐")
    assert (left.strip(), right.strip()) == ("▲", "▪")  # to the right: the left wheel turns
    assert "▲" in body
    assert words.strip() == "forward"
    assert wheels.split() == ["wheels", "+255", "+0"]
    assert speed == f"speed {'█' * 14} 255"
    assert steering.endswith("● +255")
    assert led.split() == ["led", "●", "R", "○", "G", "○", "B"]
