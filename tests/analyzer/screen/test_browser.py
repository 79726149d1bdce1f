"""The screen does what its keys and the mouse ask, from 40 x 10 to 200 x 60 and below."""

from __future__ import annotations

import time
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
from textual import events
from textual.pilot import Pilot

from bilprov.analyzer.decode.batch import Batch
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.fields import offset
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.output.console import NARROW
from bilprov.analyzer.output.row_columns import RowStyle, chosen_columns, columns_of
from bilprov.analyzer.screen.browser import Browser
from bilprov.analyzer.screen.feeds import Feed
from bilprov.analyzer.screen.keys import BINDINGS, LOOKS, MOVES
from bilprov.analyzer.screen.prompt import row_of
from bilprov.analyzer.screen.recording import View
from bilprov.captures.schemas import Chunk, Line
from bilprov.captures.text import printable
from bilprov.spec.protocol import Protocol, load
from tests.support.decoding import MS, Event
from tests.support.screens import PATIENCE, browser, operated, text_of
from tests.support.surfaces import HOSTILE
from tests.support.traffic import told

pytestmark = pytest.mark.slow  # the screen is drawn in each

SIZES = [(40, 10), (60, 15), (80, 24), (100, 30), (120, 40), (200, 60)]
SIGNS = {"/": "slash", ":": "colon", "'": "apostrophe", ".": "full_stop", " ": "space"}


def drive(count: int = 60) -> list[Event]:
    """A drive in which every tenth frame is cut short by one byte, and answered so."""
    events: list[Event] = [Line(0, "open", "", "a \x1b[31mport")]
    for at in range(count):
        frame, answer = (b"\x80", b"\x04") if at % 10 == 9 else (bytes([0x11, at % 256]), b"\0")
        t = at * 10 * MS
        events += [Chunk(t, "host", frame), Chunk(t + MS, "device", answer)]
    return events


def decoded(protocol: Protocol, events: list[Event]) -> list[Batch]:
    return told(StreamDecoder(protocol), events, [len(events)])


@pytest.fixture
def screen(protocol: Protocol) -> Browser:
    return browser(protocol, decoded(protocol, drive()))


def keys_of(words: str) -> list[str]:
    """The keys of words: each a key's name, or signs that are typed one by one."""
    names = {"enter", "escape", "space", "tab", "down", "up", "home", "end", "pagedown", "pageup"}
    return [
        SIGNS.get(key, key)
        for word in words.split()
        for key in ([word] if word in names or "+" in word else word)
    ]


async def typed(screen: Browser, pilot: Pilot[Any], text: str) -> None:
    """Press `/`, type a filter in place of the one before, and give it."""
    await pilot.press("slash")
    screen.prompt.line.value = text
    await pilot.press("enter")
    await pilot.pause()


async def test_another_row_is_drawn_in_the_layout_that_is_there(screen: Browser) -> None:
    layouts: list[object] = []

    async with operated(screen) as pilot:
        for key in ("end", "end", "home", "down", "pagedown", "t"):
            await pilot.press(key)
            await pilot.pause()
            screen.screen.screen_layout_refresh_signal.subscribe(screen, layouts.append)

    assert not layouts


async def test_the_details_have_a_scroll_bar_where_they_need_it(screen: Browser) -> None:
    async with operated(screen, (80, 24)) as pilot:
        for key, needed in (("down", True), ("up", False)):
            await pilot.press(key)
            await pilot.pause()
            assert screen.fields.show_vertical_scrollbar == needed


MOVES_TO = {
    "j down k": 1,
    "5j 12k": 0,
    "10j 3": 10,
    "end 20k home": 0,
    "120G k": 118,
    "7g": 6,
    "pagedown": 24,
    "ctrl+f ctrl+b": 0,
    "ctrl+d ctrl+d ctrl+u": 12,
    "2n": 39,
    "nnN": 19,
    ":90 enter": 89,
    "3j tab j escape j": 4,
    "999G": 120,
}


async def test_keys_move_through_the_rows(screen: Browser) -> None:
    async with operated(screen) as pilot:
        assert screen.frames.room == 24
        for keys, row in MOVES_TO.items():
            await pilot.press("home", *keys_of(keys))
            assert screen.frames.row == row, keys
            top = screen.frames.top
            assert top <= screen.frames.cursor < top + screen.frames.room
            await pilot.press("j")


@pytest.mark.parametrize(
    ("keys", "row"), [("G", 240), ("200G", 199), (": 0.7s enter", 141), ("G k", 119)]
)
async def test_a_place_that_is_not_read_yet_is_gone_to_once_it_is(
    protocol: Protocol, keys: str, row: int
) -> None:
    first, later = decoded(protocol, drive()), decoded(protocol, drive(120)[121:])
    screen = browser(protocol, first)

    async with operated(screen) as pilot:
        reading: Future[object] = Future()
        screen.feed._working = reading
        await pilot.press(*keys_of(keys))
        assert screen.frames.row == (119 if keys == "G k" else 120)
        assert screen.said == ""
        for batch in later:
            screen.feed.recording.add(batch)
        screen.tick()
        reading.set_result(None)
        screen.tick()
        assert screen.frames.row == row
        await pilot.press("g")
        screen.tick()
        assert screen.frames.row == 0


@pytest.mark.sample(4)
@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("100", 99),
        ("0.3s", 300),
        ("301 ms", 301),
        ("14:03:20.3", 300),
        ("14:03:20", 0),
        ("2026-11-22T14:03:21Z", 1000),
        ("14:03:19", 86_399_000),  # on the next day
    ],
)
def test_a_place_is_a_row_or_a_time(text: str, found: int) -> None:
    start = 1_795_356_200 * 10**9  # 2026-11-22 14:03:20 in UTC

    assert row_of(text, start, True, lambda t: t // MS) == found
    with pytest.raises(ValueError, match="give a row like 120"):
        row_of("soon", start, True, lambda t: t // MS)


def test_a_time_of_day_is_that_of_the_clock_here(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "<+01>-1")
        time.tzset()
        offset.cache_clear()
        found = row_of("01:00:00.3", 10**9, False, lambda t: t // MS)
    time.tzset()
    offset.cache_clear()
    assert found == 86_399_300  # it began a second later than one in the morning


ANSWERED = {
    "N": "no fault comes before",
    "G n": "no fault comes after",
    "2j y": "copied: bilprov send PORT '11 00'",
    "y": "no frame to copy",
    ":99999 enter": "the recording ends before that: this is its last row",
    "999G": "the recording ends before that",
    ":3600s enter": "the recording ends before that",
    ":soon enter": "give a row like 120",
    "/speeed<9 enter": "is not a name here: did you mean speed?",
    "/agr": "agrees: whether the answer is the expected one",
    "x": "NAME.csv or NAME.jsonl",
}


async def test_the_last_line_answers(screen: Browser) -> None:
    async with operated(screen) as pilot:
        for keys, words in ANSWERED.items():
            await pilot.press("escape", "home", *keys_of(keys))
            await pilot.pause()
            assert words in text_of(screen)[-1], keys


async def test_each_row_has_the_sign_and_colour_of_whose_fault_it_is(protocol: Protocol) -> None:
    frames = [
        *((b"\x20", b"\0"), (b"\x81\x09", b"\x02"), (b"\x81\x09", b"\0")),
        *((b"\x20", b"\x03"), (b"\x20", b"\x09")),
    ]
    talk = [
        Chunk(at * 10 * MS + late * MS, side, data)
        for at, pair in enumerate(frames)
        for late, side, data in zip((0, 1), ("host", "device"), pair, strict=True)
    ]
    screen = browser(protocol, decoded(protocol, [*talk, Line(90 * MS, "overrun", "host")]))

    async with operated(screen) as pilot:
        _, *rows = screen.frames.lines(0, screen.frames.count, 90)
        assert "".join(row.plain[0] for row in rows) == "  !-!x x x~"
        styles = {look.sign: look.style for look in LOOKS}
        for row in rows:
            first = "".join(str(span.style) for span in row.spans if not span.start)
            assert first == styles.get(row.plain[0], "")
        await pilot.press("j")
        grounds = [next(iter(screen.frames.render_line(y))).style for y in (1, 2, 3)]
        assert [bool(style and style.bgcolor) for style in grounds] == [False, True, False]


async def test_neither_high_row_numbers_nor_long_pauses_are_cut(screen: Browser) -> None:
    async with operated(screen):
        record = screen.frames.record
        assert record is not None
        screen.feed.recording.rows = 12_345_678
        line = screen.frames._line(12_345_677, record, record.t - 2_000_000 * MS, 80).plain
        assert line.split()[:3] == ["12345678", "0.0000", "2000000"]


async def test_the_head_has_grammar_and_line_and_the_heading_is_dim(screen: Browser) -> None:
    async with operated(screen) as pilot:
        assert text_of(screen)[0].startswith("a test · robot-car 1.1 · 115200 8N1   ")
        styles = [segment.style for segment in screen.frames.render_line(0) if segment.text.strip()]
        assert all(style and style.dim for style in styles)
        await pilot.resize_terminal(40, 10)
        await pilot.press(":")
        await pilot.pause()
        assert "…  121 rows" in text_of(screen)[0]
        assert text_of(screen)[-1].endswith("…")


async def test_bytes_are_as_wide_as_the_longest_row_and_how_short_a_frame_is_stands_once(
    screen: Browser,
) -> None:
    async with operated(screen, (200, 60)) as pilot:
        await pilot.press("n")
        await pilot.pause()
        heading, *_ = (line for line in text_of(screen) if "bytes" in line)
        assert heading.index("what") - heading.index("bytes") < 20
        rows = [line for line in text_of(screen)[:30] if line.startswith("!")]
        assert rows
        assert not any("announced" in row for row in rows)


async def test_the_first_row_of_a_quiet_line_is_drawn_when_it_comes(
    protocol: Protocol, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bilprov.analyzer.screen.browser._DRAWING_SHARE", 1e-9)
    screen = browser(protocol, [], live=True)

    async with operated(screen) as pilot:
        (batch,) = decoded(protocol, [Line(0, "open", "", "a port")])
        screen.feed.recording.add(batch)
        screen.tick()  # what the first layout took is no reason to wait
        await pilot.pause()
        assert any("time  0.000000000 s" in line for line in text_of(screen))


async def written(pilot: Pilot[Any], screen: Browser, file: str) -> None:
    """Press x, name the file, and wait until it is written."""
    await pilot.press("x")
    screen.prompt.line.value = file
    await pilot.press("enter")
    await screen.workers.wait_for_complete()
    await pilot.pause()


async def test_a_filter_shows_how_many_rows_pass_and_export_writes_them(
    screen: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.csv").write_text("precious")

    async with operated(screen) as pilot:
        await pilot.press(*"4j")
        await typed(screen, pilot, "speed < 9")
        assert (screen.frames.count, screen.frames.row) == (9, 5)
        first = text_of(screen)[0]
        assert (first[:11], first[-10:]) == ("/ speed < 9", "  9 of 121")
        for name, words in (("there.csv", "never overwritten"), ("a.txt", ".csv or .jsonl")):
            await written(pilot, screen, name)
            assert words in text_of(screen)[-1]
            await pilot.press("escape")
        await written(pilot, screen, "out.csv")
        assert "9 rows written to out.csv" in text_of(screen)[-1]
        await typed(screen, pilot, "")
        assert "121 rows" in text_of(screen)[0]
        await written(pilot, screen, "out.jsonl")  # the line's event is none of its rows
        assert "120 rows written to out.jsonl" in text_of(screen)[-1]
        await pilot.press("e")
        assert text_of(screen)[0].startswith("/ faulty ")
        assert text_of(screen)[0].endswith(" 12 of 121")
        await pilot.press("e")
        assert screen.frames.count == 121
    assert (tmp_path / "there.csv").read_text() == "precious"
    lines = (tmp_path / "out.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 10
    assert lines[1].startswith("0.0,host,instruction,11 00,Speed,")
    assert len((tmp_path / "out.jsonl").read_text().splitlines()) == 120


async def type_ahead(screen: Browser, pilot: Pilot[Any], *keys: str) -> None:
    """Keys that have all come before the screen handles the first."""
    for key in keys:
        name = SIGNS.get(key, "equals_sign" if key == "=" else key)
        screen.post_message(events.Key(name, key if len(key) == 1 else None))
    await pilot.pause()
    await pilot.pause()


@pytest.mark.sample(2)
@pytest.mark.parametrize("text", ["sequence == 3", "faulty", "not quiet", "q"])
async def test_keys_typed_ahead_behind_the_slash_are_the_filter(screen: Browser, text: str) -> None:
    async with operated(screen) as pilot:
        follows, style = screen.follows, screen.frames.time_style
        await type_ahead(screen, pilot, "/", *text[:2])
        await type_ahead(screen, pilot, *text[2:])  # the focus has come by now
        assert screen.prompt.line.value == text
        assert screen.is_running
        assert (screen.follows, screen.frames.time_style) == (follows, style)


async def test_tab_and_enter_typed_ahead_come_behind_the_text_before_them(screen: Browser) -> None:
    async with operated(screen) as pilot:
        await type_ahead(screen, pilot, "/", *"faulty and lat", "tab", *" > 1", "escape")
        assert screen.prompt.line.value == "faulty and latency > 1"
        await type_ahead(screen, pilot, "/", *"faulty", "enter", "n", "n")
        assert (screen.filter_text, screen.frames.row) == ("faulty", 59)
        await type_ahead(screen, pilot, ":", *"20", "enter", "j")
        assert screen.frames.row == 20


async def test_a_paste_goes_into_the_line_that_is_typed_or_is_a_filter(screen: Browser) -> None:
    async with operated(screen) as pilot:
        for text in ("/speed < 9", " and speed\n> 2"):
            screen.post_message(events.Paste(text))
        await type_ahead(screen, pilot, "enter")
        assert screen.filter_text == "speed < 9 and speed > 2"


async def test_tab_completes_names_and_values_in_the_middle_of_a_filter(screen: Browser) -> None:
    async with operated(screen) as pilot:
        line = screen.prompt.line
        await pilot.press("slash", *"name == rotater", "tab")
        assert line.value == "name == RotateRight"
        line.value, line.cursor_position = "lat > 1", 3
        await pilot.press("tab")
        assert line.value == "latency > 1"
        line.value = "no ways to go on"
        await pilot.press("tab")
        assert line.value == "no ways to go on"


async def test_space_holds_the_view_still_while_rows_come(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()), live=True)

    async with operated(screen) as pilot:
        assert screen.frames.row == 120  # a live view follows
        await pilot.press("space")
        for batch in decoded(protocol, drive(10)):
            screen.feed.recording.add(batch)
        screen.show_rows()
        await pilot.pause()
        assert "paused, 21 waiting" in text_of(screen)[0]
        assert (screen.frames.count, screen.frames.row) == (121, 120)
        await typed(screen, pilot, "direction == host")  # which does not end the pause
        assert "paused, 10 waiting" in text_of(screen)[0]
        assert screen.frames.count == 60
        await pilot.press("n")
        assert "no fault comes after" in text_of(screen)[-1]
        await typed(screen, pilot, "")
        await pilot.press("space")
        assert (screen.frames.count, screen.frames.row) == (142, 141)


async def test_space_plays_a_capture_from_the_chosen_row_and_stops(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()), rate=1e-3)

    async with operated(screen) as pilot:
        await pilot.press("down", "down", "space")
        await pilot.pause()
        assert "playing" in text_of(screen)[0]
        await pilot.press(*"60j")  # by hand: it goes on from there
        screen.tick()
        await pilot.pause()
        row, record = screen.frames.row, screen.frames.record
        assert record is not None
        assert row in (62, 63)
        assert f"playing {record.t / 1e9:.1f} s" in text_of(screen)[0]
        await pilot.press("space")
        await pilot.pause()
        assert "playing" not in text_of(screen)[0]


async def test_a_capture_played_without_pauses_is_at_its_end_at_once(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()), rate=0)

    async with operated(screen) as pilot:
        await pilot.press("space")
        screen.tick()
        await pilot.pause()
        assert screen.frames.row == 120
        assert "playing" not in text_of(screen)[0]


async def test_f_follows_what_comes_until_the_choice_is_moved(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()), live=True)
    rows = []

    async with operated(screen) as pilot:
        # Moved by hand; out of a pause; no more; and out of a pause again.
        for keys in ("up", "space f", "f", "f space f"):
            await pilot.press(*keys_of(keys))
            for batch in decoded(protocol, drive(1)):
                screen.feed.recording.add(batch)
            screen.show_rows()
            rows.append(screen.frames.row)
    assert rows == [119, 126, 126, 132]


async def test_a_followed_file_that_grows_no_more_is_called_quiet(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()), live=True)

    async with operated(screen, (60, 15)) as pilot:
        for since, words in ((5, "  following  121 rows"), (42, "following, quiet for 42 s")):
            screen.feed.grew = time.monotonic() - since
            screen.tick()
            await pilot.pause()
            assert words in text_of(screen)[0]


async def test_the_rows_stay_where_they_are_while_the_oldest_are_let_go(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive(2100)))

    async with operated(screen) as pilot:
        screen.feed.recording.let_go_oldest()
        screen.show_rows()
        assert screen.frames.row == screen.feed.recording.first > 0
        for batch in decoded(protocol, drive(2100)):
            screen.feed.recording.add(batch)
        await pilot.press("end", "9", "9", "k")
        await pilot.pause()
        before = [line[:90] for line in text_of(screen)[1:20]]
        screen.feed.recording.let_go_oldest()
        screen.show_rows()
        await pilot.pause()
        assert [line[:90] for line in text_of(screen)[1:20]] == before


async def test_times_are_shown_in_each_style_and_from_a_row_on(screen: Browser) -> None:
    shown = []

    async with operated(screen) as pilot:
        await pilot.press("end")
        for key in "tttkr":
            shown.append(text_of(screen)[screen.frames.region.bottom - 1].split()[1:4])
            await pilot.press(key)
            await pilot.pause()
        assert "since row" in text_of(screen)[1]
        assert text_of(screen)[screen.frames.region.bottom - 1].split()[2] == "0.0010"
    assert shown[0] == shown[3] == ["121", "0.5910", "1.0"]
    assert shown[2] == ["121", "00:00:00.5910", "1.0"]


async def test_columns_that_are_asked_for_are_those_of_an_export_too(
    protocol: Protocol, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = RowStyle(None, chosen_columns("time,state.speed", columns_of(protocol)))
    screen = browser(protocol, decoded(protocol, drive()), rows=rows)

    async with operated(screen) as pilot:
        assert text_of(screen)[1].split()[:2] == ["time", "speed"]
        await written(pilot, screen, "out.csv")
    assert (tmp_path / "out.csv").read_text().splitlines()[0] == "time,state.speed"


async def test_the_fields_light_their_bytes_and_stay_folded(screen: Browser) -> None:
    async with operated(screen) as pilot:
        await pilot.press("j", "enter", "j", "j")
        assert screen.fields.has_focus
        screen.show_rows()  # as it does when rows come
        await pilot.pause()
        assert screen.frames.lit == range(1, 2)  # the speed's
        assert any("speed 0000 0000 0 speed" in " ".join(line.split()) for line in text_of(screen))
        await pilot.press("j", "l", "j", "h")  # from a line below its heading
        await pilot.press("escape", "j", "j")
        shown = text_of(screen)
        assert any("▸ answer" in line for line in shown)
        assert not any("sets" in line for line in shown)
        await pilot.press("enter", *"3j", "l")
        assert any("sets" in line for line in text_of(screen))


async def test_the_mouse_chooses_rows_and_scrolls(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()), live=True)

    async with operated(screen) as pilot:
        await pilot._post_mouse_events([events.MouseScrollUp] * 3, "#frames", offset=(5, 5))
        assert not screen.follows
        assert screen.frames.row == screen.frames.top + screen.frames.room - 1 < 120
        await pilot.press("g")
        await pilot.click("#frames", offset=(10, 5))
        assert screen.frames.row == 4
        await pilot._post_mouse_events([events.MouseScrollDown] * 6, "#frames", offset=(5, 5))
        assert screen.frames.row == screen.frames.top > 4
        await pilot.click("#frames", offset=(10, 0))  # the heading is no row
        assert screen.frames.row == screen.frames.top


async def test_the_help_lists_every_key_and_scrolls(screen: Browser) -> None:
    async with operated(screen, (120, 50)) as pilot:
        await pilot.press("question_mark")
        await pilot.pause()
        shown = "\n".join(text_of(screen))
        assert all(key.key_display in shown for key in BINDINGS if key.tooltip)
        assert all(keys in shown for keys in MOVES)
        await pilot.resize_terminal(80, 24)
        await pilot.press("G")
        await pilot.pause()
        assert any("fault of the line" in line for line in text_of(screen))
        await pilot.press("q")
        assert screen.frames.has_focus


@pytest.mark.parametrize("key", ["q", "ctrl+c", "ctrl+q"])
async def test_the_screen_is_left_by(screen: Browser, key: str) -> None:
    async with operated(screen) as pilot:
        await pilot.press(key)
    assert screen.return_code == 0


@pytest.mark.parametrize("before", ["q", "ctrl+c", "slash ctrl+c", "question_mark ctrl+c"])
@pytest.mark.parametrize(("last", "kept"), [("enter", "kept.mcap"), ("ctrl+c", None)])
async def test_a_session_that_would_be_lost_is_offered_for_saving(
    protocol: Protocol,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    before: str,
    last: str,
    kept: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.mcap").write_text("precious")
    screen = browser(protocol, decoded(protocol, drive()), live=True)
    screen.feed.keeps = True

    async with operated(screen) as pilot:
        await pilot.press(*before.split(), "escape")
        assert screen.frames.has_focus
        await pilot.press(*before.split())
        await type_ahead(screen, pilot, *"there", ".", *"mcap", "enter")
        assert "never overwritten" in text_of(screen)[-1]
        screen.prompt.line.value = "kept.mcap"
        await pilot.press(last)
    assert screen.return_value == kept


async def test_a_filter_can_be_stopped(protocol: Protocol, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = browser(protocol, decoded(protocol, drive(11_000)))

    async with operated(screen) as pilot:
        with monkeypatch.context() as patch:
            patch.setattr(View, "catch_up", lambda view, most: view.test is None)
            await typed(screen, pilot, "direction == host")
            assert "filter 0%, Esc stops it" in text_of(screen)[-1]
            await pilot.press("escape")
            await pilot.pause()
            screen.tick()
        assert "the filter was stopped" in text_of(screen)[-1]
        assert screen.frames.count == 22_001
        await typed(screen, pilot, "direction == host")
        await screen.workers.wait_for_complete()
        screen.tick()
        assert screen.frames.count == 11_000


@pytest.mark.sample(1)
@pytest.mark.parametrize("size", [*SIZES, (39, 9), (20, 5), (10, 2), (1, 1)])
async def test_nothing_overlaps_at_any_size(protocol: Protocol, size: tuple[int, int]) -> None:
    screen = browser(protocol, decoded(protocol, drive()))

    async with operated(screen, size) as pilot:
        await pilot.press("n", "enter", "escape", "slash", "escape", "question_mark", "escape")
        await pilot.pause()
        if size not in SIZES:
            return  # too small to be of use; it only must not fail
        panes = {
            name: widget.region
            for name in ("head", "frames", "fields", "car", "figures", "status")
            if (widget := screen.query_one(f"#{name}")).region.area
        }
        assert ("fields" in panes, "car" in panes) == (size[1] >= 15, size[0] >= 110)
        assert any("state " in line for line in text_of(screen)) == (20 <= size[1] < 40)
        regions = list(panes.values())
        for at, region in enumerate(regions):
            assert screen.screen.region.contains_region(region)
            assert not any(region.overlaps(other) for other in regions[at + 1 :])
        assert screen.frames.room >= size[1] // 2
        assert any("80 " in line and "LED" in line for line in text_of(screen))  # bytes and words
        assert {len(line) for line in text_of(screen)} == {size[0]}


async def test_where_the_fields_have_no_room_enter_shows_them_alone(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()))

    async with operated(screen, (40, 10)) as pilot:

        def panes() -> list[bool]:
            return [bool(pane.display) for pane in (screen.frames, screen.fields)]

        await pilot.press("enter")
        assert (panes(), screen.fields.has_focus) == ([False, True], True)
        await pilot.press("escape")
        assert (panes(), screen.frames.has_focus) == ([True, False], True)
        await pilot.press("enter", "slash", "escape")
        assert (panes(), screen.frames.has_focus) == ([True, False], True)


async def test_keys_work_on_where_the_pane_with_the_focus_has_vanished(screen: Browser) -> None:
    async with operated(screen) as pilot:
        await pilot.press("tab")
        for size in ((40, 10), (120, 40)):
            await pilot.resize_terminal(*size)
            await pilot.pause()
        await pilot.press("j", "G")
        assert screen.frames.row == 120


async def test_a_filter_goes_on_with_the_rows_that_come(protocol: Protocol) -> None:
    test = compile_filter("direction == host", protocol)
    told = {"expression": "direction == host", "test": test}
    screen = browser(protocol, decoded(protocol, drive()), live=True, **told)

    async with operated(screen) as pilot:
        assert screen.filter_text == "direction == host"
        rows = 0
        for count in (60, 5, 10_001):  # so many are filtered beside
            for batch in decoded(protocol, drive(count)) if rows else ():
                screen.feed.recording.add(batch)
            rows += count
            give_up = time.monotonic() + PATIENCE
            while screen.frames.count < rows and time.monotonic() < give_up:
                screen.tick()
                await pilot.pause(0.01)
            assert screen.frames.count == rows


async def test_markup_of_a_grammar_is_shown_as_it_is(horn_text: str) -> None:
    protocol = load(horn_text.replace('9: "Horn"', '9: "Ho[/x][red]rn"'))
    screen = browser(protocol, decoded(protocol, [Chunk(0, "host", b"\x91\x03")]))

    async with operated(screen) as pilot:
        await pilot.press("slash", *"name == Ho")
        await pilot.pause()
        assert sum("Ho[/x][red]" in line for line in text_of(screen)) >= 3  # list, fields, prompt


async def test_every_sign_has_one_in_ascii(screen: Browser) -> None:
    async with operated(screen) as pilot:
        await pilot.press("n", "enter")
        for key in ("question_mark", "escape", "x"):
            await pilot.press(key)
            await pilot.pause()
            for sign in set("".join(text_of(screen))) - {"?"}:
                if not sign.isascii():
                    assert sign.encode("ascii", NARROW) != b"?"


async def test_an_error_of_the_feed_closes_the_screen_and_is_raised(protocol: Protocol) -> None:
    screen = browser(protocol, [])

    def fail(feed: Feed) -> None:
        raise OSError("gone")

    screen.feed.work = fail

    with pytest.raises(OSError, match="gone"):
        async with operated(screen):
            pass


@pytest.mark.sample(2)
@pytest.mark.parametrize("name", HOSTILE)
async def test_a_hostile_text_does_nothing_to_the_screen(protocol: Protocol, name: str) -> None:
    evil = HOSTILE[name]
    events = [Line(0, evil, "", evil), *drive(5), Line(60 * MS, "unplugged", "host", evil)]
    screen = browser(protocol, decoded(protocol, events), expression=evil)
    screen.feed.notice = screen.feed.said = screen.feed.captured = evil
    shown: list[str] = []

    async with operated(screen, (160, 40)) as pilot:
        for key in ("home", "down", "end", "question_mark"):
            await pilot.press(key)
            await pilot.pause()
            shown.extend(text_of(screen))

    assert all(line.isprintable() for line in shown)
    assert any(printable(evil)[:8] in line for line in shown)
