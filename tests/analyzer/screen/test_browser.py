"""The screen does what its keys and the mouse ask, from 40 x 10 to 200 x 60 and below."""

from __future__ import annotations

import time
from bisect import bisect_right
from pathlib import Path
from typing import Any

import pytest
from textual import events
from textual.pilot import Pilot
from textual.widgets import Input

from bilprov.analyzer.decode.batch import Batch
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.output.row_columns import TimeStyle
from bilprov.analyzer.screen.arrangement import arranged
from bilprov.analyzer.screen.browser import Browser
from bilprov.analyzer.screen.feeds import Feed
from bilprov.analyzer.screen.keys import BINDINGS, KEYS
from bilprov.analyzer.screen.rows import Rows
from bilprov.analyzer.screen.signs import PLAIN
from bilprov.captures.schemas import Chunk, Line
from bilprov.captures.text import printable
from bilprov.spec.protocol import Protocol, load
from tests.support.decoding import MS, Event
from tests.support.screens import PATIENCE, browser, operated, text_of
from tests.support.surfaces import HOSTILE
from tests.support.traffic import told

pytestmark = pytest.mark.slow  # the screen is drawn in each

SIZES = [(40, 10), (60, 15), (80, 24), (100, 30), (132, 43), (200, 60)]


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


def words_of(screen: Browser) -> str:
    record = screen.frames.record
    assert isinstance(record, HostRecord | DeviceRecord)
    return record.words


def test_keys_move_through_the_rows(screen: Browser) -> None:
    rows = []

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        room = screen.frames.room
        for key in ("down", "j", "up", "k", "pagedown", "pageup", "end", "G", "home", "g"):
            await pilot.press(key)
            rows.append(screen.frames.row)
        assert rows[4] == room - 1

    operated(screen, steps)
    assert rows[:4] == [1, 2, 1, 0]
    assert rows[5:] == [0, 120, 120, 0, 0]


def test_n_goes_from_fault_to_fault_and_back(screen: Browser) -> None:
    rows = []

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        for key in "nnNnN":
            await pilot.press(key)
            rows.append((screen.frames.row, words_of(screen)))
        await pilot.press("N")
        assert "no fault comes before" in text_of(screen)[-1]

    operated(screen, steps)
    assert [row for row, _ in rows] == [19, 39, 19, 39, 19]
    assert rows[0][1].startswith("LED")


async def export_rows(pilot: Pilot[Any], screen: Browser, file: str) -> None:
    """Press x, name the file, and wait until it is written."""
    await pilot.press("x")
    screen.screen.query_one(Input).value = file
    await pilot.press("enter")
    while screen.export:
        await pilot.pause(0.01)
        screen.tick()


async def type_filter(pilot: Pilot[Any], text: str) -> None:
    await pilot.press("slash", *text)


def test_a_filter_shows_what_passes_and_export_writes_it(
    screen: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press(*"jjjj")
        row = screen.frames.row
        await type_filter(pilot, "speed < 9")
        await pilot.press("enter")
        assert (screen.frames.count, screen.frames.row) == (9, 5)
        assert row == 4
        assert "filter: speed < 9" in text_of(screen)[-1]
        await export_rows(pilot, screen, "out.csv")
        assert "9 rows written to out.csv" in text_of(screen)[-1]
        await pilot.press("slash")
        assert screen.prompt.query_one(Input).value == "speed < 9"
        await pilot.press("escape")
        assert screen.frames.count == 9
        await pilot.press("slash")
        screen.prompt.query_one(Input).value = ""
        await pilot.press("enter")
        assert screen.frames.count == 121

    operated(screen, steps)
    lines = (tmp_path / "out.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 10
    assert lines[1].startswith("0.0,host,instruction,11 00,Speed,")


def test_jsonl_is_exported_with_its_keys_and_no_file_is_overwritten(
    screen: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.csv").write_text("precious")

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("x")
        for name, words in (("there.csv", "never overwritten"), ("a.txt", ".csv or .jsonl")):
            screen.screen.query_one(Input).value = name
            await pilot.press("enter")
            assert any(words in line for line in text_of(screen))
        screen.screen.query_one(Input).value = "out.jsonl"
        await pilot.press("enter")
        while screen.export:
            await pilot.pause(0.01)
            screen.tick()

    operated(screen, steps)
    assert (tmp_path / "there.csv").read_text() == "precious"
    assert len((tmp_path / "out.jsonl").read_text().splitlines()) == 120
    assert screen.said == "120 rows written to out.jsonl"  # the line's event is none of them


def test_a_wrong_filter_says_so_under_it_and_escape_leaves_all_rows(screen: Browser) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await type_filter(pilot, "speeed < 9")
        await pilot.press("enter")
        await pilot.pause()
        shown = text_of(screen)
        assert "filter / speeed < 9" in shown[-2]
        assert "is not a name here: did you mean speed?" in shown[-1]
        await pilot.press("escape")
        assert screen.frames.has_focus
        assert screen.frames.count == 121

    operated(screen, steps)


def test_tab_completes_names_and_values(screen: Browser) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await type_filter(pilot, "late")
        await pilot.pause()
        assert "latency" in text_of(screen)[-1]
        await pilot.press("tab")
        assert screen.prompt.query_one(Input).value == "latency"
        await pilot.press(*" > 1 and name == rotater", "tab")
        assert screen.prompt.query_one(Input).value.endswith("RotateRight")
        typed = screen.prompt.query_one(Input)
        typed.value, typed.cursor_position = "l > 1", 1
        found = []
        for _ in range(4):
            await pilot.press("tab")
            found.append(typed.value)
        assert all(text.endswith(" > 1") for text in found)
        assert found[0] == found[2] != found[1] == found[3]  # len, latency

    operated(screen, steps)


def test_typed_letters_are_no_commands_while_a_filter_is_typed(screen: Browser) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await type_filter(pilot, "q")
        assert screen.prompt.query_one(Input).value == "q"

    assert operated(screen, steps) is None
    assert screen.return_value is None


async def type_ahead(screen: Browser, pilot: Pilot[Any], *keys: str) -> None:
    """Keys that have all come before the screen handles the first."""
    for key in keys:
        name = {"/": "slash", " ": "space", "=": "equals_sign"}.get(key, key)
        screen.post_message(events.Key(name, key if len(key) == 1 else None))
    await pilot.pause()
    await pilot.pause()


@pytest.mark.parametrize("text", ["sequence == 3", "faulty", "not quiet"])
def test_keys_typed_ahead_behind_the_slash_are_the_filter(screen: Browser, text: str) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        follows, style = screen.follows, screen.frames.time_style
        await type_ahead(screen, pilot, "/", *text)
        assert screen.prompt.query_one(Input).value == text
        assert screen.is_running
        assert (screen.follows, screen.frames.time_style) == (follows, style)

    operated(screen, steps)


def test_tab_and_enter_typed_ahead_come_behind_the_text_before_them(screen: Browser) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await type_ahead(screen, pilot, "/", *"faulty and lat", "tab")
        assert screen.prompt.query_one(Input).value == "faulty and latency"
        await type_ahead(screen, pilot, "escape", "/", *"faulty", "enter", "n", "t")
        assert screen.filter_text == "faulty"
        assert not screen.prompt.display
        assert screen.frames.time_style is not TimeStyle.RELATIVE

    operated(screen, steps)


def test_a_filter_shows_how_many_rows_there_are_in_all(screen: Browser) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        rows = screen.feed.recording.rows
        assert f"1 of {rows}" in text_of(screen)[0]
        await type_filter(pilot, "faulty and direction == host")
        await pilot.press("enter")
        await pilot.pause()
        assert f"of 6 filtered from {rows}" in text_of(screen)[0]

    operated(screen, steps)


def test_space_holds_the_view_still_while_rows_come(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()), live=True)

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        assert screen.frames.row == 120  # a live view follows
        await pilot.press("space")
        for batch in decoded(protocol, drive(10)):
            screen.feed.recording.add(batch)
        screen.show_rows()
        await pilot.pause()
        assert "paused, 21 waiting" in text_of(screen)[0]
        assert (screen.frames.count, screen.frames.row) == (121, 120)
        faults = screen.faults.count
        await type_filter(pilot, "direction == host")  # which does not end the pause
        await pilot.press("enter")
        await pilot.pause()
        assert "paused, 10 waiting" in text_of(screen)[0]
        assert (screen.frames.count, screen.faults.count) == (60, faults)
        await pilot.press("n")
        assert "no fault comes after" in text_of(screen)[-1]
        await pilot.press("slash")
        screen.prompt.query_one(Input).value = ""
        await pilot.press("enter", "space")
        assert screen.faults.count == faults + 1
        assert (screen.frames.count, screen.frames.row) == (142, 141)

    operated(screen, steps)


def test_space_plays_a_capture_from_the_chosen_row_and_stops(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()), rate=1e-3)

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("down", "down", "space")
        await pilot.pause()
        assert "playing" in text_of(screen)[0]
        await pilot.press(*["pagedown"] * 4)  # by hand: it goes on from there
        screen.tick()
        await pilot.pause()
        row, record = screen.frames.row, screen.frames.record
        assert record is not None
        assert record.t > 2e8
        assert f"playing {record.t / 1e9:.1f} s" in text_of(screen)[0]
        await pilot.press("space")
        await pilot.pause()
        assert "playing" not in text_of(screen)[0]
        assert screen.frames.row == row

    operated(screen, steps)


def test_a_capture_that_is_played_without_pauses_is_at_its_end_at_once(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()), rate=0)

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("space")
        screen.tick()
        await pilot.pause()
        assert screen.frames.row == 120
        assert "playing" not in text_of(screen)[0]

    operated(screen, steps)


@pytest.mark.parametrize("expression", ["", "direction == host"])
def test_what_is_played_is_the_last_row_whose_time_has_come(
    screen: Browser, expression: str
) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        if expression:
            await type_filter(pilot, expression)
            await pilot.press("enter")
            await pilot.pause()
        frames = screen.frames
        rows = frames.view.rows(0, frames.count)
        times = [record.t for record in screen.feed.recording.records(rows)]
        for t in (times[0], times[2] - 1, times[5], times[70 % len(times)], times[-1] + 1):
            assert frames.position_at(t) == bisect_right(times, t) - 1
        frames.choose(9)
        assert frames.position_at(times[3]) == 9  # it never goes back

    operated(screen, steps)


def test_f_follows_what_comes_until_the_choice_is_moved(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()), live=True)

    def more() -> None:
        for batch in decoded(protocol, drive(1)):
            screen.feed.recording.add(batch)
        screen.show_rows()

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("up")
        more()
        assert screen.frames.row == 119
        await pilot.press("space", "f")  # also out of a pause
        assert screen.frames.row == 123
        more()
        assert screen.frames.row == 126
        await pilot.press("f")
        more()
        assert screen.frames.row == 126
        await pilot.press("f", "space", "f")  # which goes on from the pause
        more()
        assert screen.frames.row == 132

    operated(screen, steps)


def test_m_marks_rows_and_the_apostrophe_goes_round_them(screen: Browser) -> None:
    rows = []

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("j", "m", "j", "j", "m")
        assert sum("◆" in line for line in text_of(screen)) == 2
        for _ in range(3):
            await pilot.press("apostrophe")
            rows.append(screen.frames.row)
        await pilot.press("m", "apostrophe")
        rows.append(screen.frames.row)
        await pilot.press("m", "m", "apostrophe", "m", "apostrophe")
        assert "no row is marked" in text_of(screen)[-1]

    operated(screen, steps)
    assert rows == [1, 3, 1, 3]


def test_marks_go_with_the_rows_that_are_let_go(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive(2100)))

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("m")
        screen.feed.recording.let_go_oldest()
        screen.show_rows()
        assert screen.frames.row == screen.feed.recording.first > 0
        await pilot.press("apostrophe")
        assert "no row is marked" in text_of(screen)[-1]

    operated(screen, steps)


def test_t_shows_times_in_each_style_in_turn(screen: Browser) -> None:
    shown = []

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("end")
        for _ in range(5):
            shown.append(text_of(screen)[screen.frames.region.bottom - 1].split()[1])
            await pilot.press("t")
            await pilot.pause()
        top = screen.frames.region.y + 2
        assert text_of(screen)[top].split()[1] in ("0.001000", "0.009000")  # since a hidden row

    operated(screen, steps)
    assert shown[0] == shown[4] == "0.591000"
    assert shown[1] == "0.001000"
    assert shown[3].endswith("T00:00:00.591000Z")


def test_c_chooses_columns_also_of_an_export(
    screen: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("c", "space", "escape")
        assert screen.frames.columns is None
        await pilot.press("c")
        shown = text_of(screen)
        assert any("● what " in line for line in shown)
        assert any("○ kind " in line for line in shown)
        listed = screen.screen.query_one(Rows)
        names = [str(line).split()[1] for line in listed.lines(0, listed.count, 60)]
        for name in ("what", "hex", "reason", "state.speed"):
            listed.choose(names.index(name))
            await pilot.press("space")
        await pilot.press("enter")
        assert screen.frames.columns is not None
        assert [column.name for column in screen.frames.columns] == ["time", "state.speed"]
        assert text_of(screen)[2].split()[:2] == ["time", "speed"]
        await export_rows(pilot, screen, "out.csv")
        await pilot.press("c")
        listed = screen.screen.query_one(Rows)
        for name in ("time", "state.speed"):
            listed.choose(names.index(name))
            await pilot.press("space")
        await pilot.press("c")
        assert screen.frames.columns is None  # none is the usual ones

    operated(screen, steps)
    assert (tmp_path / "out.csv").read_text().splitlines()[0] == "time,state.speed"


def test_the_tree_and_the_bytes_show_the_chosen_field(screen: Browser) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("j", "enter")
        assert screen.fields.has_focus
        await pilot.press(*"jjj")
        group = screen.fields.group
        assert group is not None
        assert group.name == "speed"
        await pilot.press("g", "enter")
        assert not any("0001 ...." in line for line in text_of(screen))
        await pilot.press("enter", "escape")
        assert screen.frames.has_focus
        for place, name in (((9, 1), "speed"), ((1, 2), "id"), ((6, 2), "length")):
            await pilot.click("#hex", offset=place)
            assert screen.fields.group is not None
            assert screen.fields.group.name == name

    operated(screen, steps)


def test_tab_goes_round_the_panes_and_enter_from_a_fault_to_its_frame(screen: Browser) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("tab")
        assert screen.fields.has_focus
        await pilot.press("tab")
        assert screen.faults.has_focus
        await pilot.press("home", "down", "enter")
        assert screen.frames.has_focus
        assert screen.frames.row == 39

    operated(screen, steps)


def hex_styles(screen: Browser) -> list[tuple[str, Any]]:
    """The pieces of the bytes' pane, each with its style."""
    console = screen.console
    return [
        (segment.text, segment.style)
        for segment in screen.hex.render().render(console)
        if segment.style is not None
    ]


def test_the_mouse_chooses_rows_and_fields_and_scrolls(screen: Browser) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.click("#frames", offset=(10, 5))
        assert screen.frames.row == 3
        await pilot.click("#tree", offset=(10, 4))
        assert screen.fields.group is not None
        assert screen.fields.group.name == "speed"
        marked = [bit for bit, at in hex_styles(screen) if at.reverse]
        assert "".join(marked) == "01" + "00000001"  # the byte 01, and each of its bits
        await pilot.click("#tree", offset=(1, 1))  # the sign before a heading
        assert screen.fields._folded == {"Instruction"}
        await pilot._post_mouse_events([events.MouseScrollDown], "#frames", offset=(5, 5))
        assert screen.frames.top == 3
        await pilot._post_mouse_events([events.MouseScrollDown] * 2, "#frames", offset=(5, 5))
        assert screen.frames.row == screen.frames.top == 9
        await pilot._post_mouse_events([events.MouseScrollUp], "#frames", offset=(5, 5))
        assert screen.frames.top == 6
        width = screen.frames.size.width
        bottom = (width - 1, screen.frames.size.height)
        await pilot.mouse_down("#frames", offset=bottom)
        await pilot.mouse_up("#frames", offset=bottom)
        assert screen.frames.row == 120

    operated(screen, steps)


def test_the_help_lists_every_key(screen: Browser) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("question_mark")
        await pilot.pause()
        shown = "\n".join(text_of(screen))
        assert all(key in shown for key in KEYS)
        signs = {"slash": "/", "apostrophe": "'", "question_mark": "?", "escape": "Esc"}
        listed = {word for keys in KEYS for word in keys.replace(",", "").split()}
        bound = {binding.key.split(",")[0] for binding in BINDINGS} - {"ctrl+c", "space"}
        assert {signs.get(key, key) for key in bound} <= listed
        await pilot.press("q")
        assert screen.frames.has_focus

    operated(screen, steps)


@pytest.mark.parametrize("key", ["q", "ctrl+c", "ctrl+q"])
def test_the_screen_is_left_by(screen: Browser, key: str) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press(key)

    operated(screen, steps)
    assert screen.return_code == 0


def test_a_session_that_would_be_lost_is_offered_for_saving(
    protocol: Protocol, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.mcap").write_text("precious")

    def offered() -> Browser:
        screen = browser(protocol, decoded(protocol, drive()), live=True)
        screen.feed.keeps = True
        return screen

    async def save(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("q", "escape")
        assert screen.frames.has_focus
        await pilot.press("q", "y")
        screen.screen.query_one(Input).value = "there.mcap"
        await pilot.press("enter")
        assert any("never overwritten" in line for line in text_of(screen))
        screen.screen.query_one(Input).value = "kept.mcap"
        await pilot.press("enter")

    async def throw_away(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("q", "n")

    assert operated(offered(), save) == "kept.mcap"
    assert operated(offered(), throw_away) is None


def test_a_long_filter_can_be_stopped(screen: Browser, protocol: Protocol) -> None:
    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        with screen.feed.recording.lock:  # so that the filter gets nowhere
            screen._filter("faulty", compile_filter("faulty", protocol))
            await pilot.pause()
            assert "Esc stops it" in text_of(screen)[-1]
            await pilot.press("escape")
        assert screen.filtering is None or screen.filtering.cancelled.is_set()
        while screen.filtering:
            await pilot.pause(0.01)
            screen.tick()
        assert "the filter was stopped" in text_of(screen)[-1]
        assert screen.frames.count == 121

    operated(screen, steps)


@pytest.mark.sample(4)
@pytest.mark.parametrize("size", [*SIZES, (39, 9), (20, 5), (10, 2), (1, 1)])
def test_nothing_overlaps_at_any_size(protocol: Protocol, size: tuple[int, int]) -> None:
    screen = browser(protocol, decoded(protocol, drive()))

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("n", "enter", "escape", "slash", "escape")
        panes = [
            widget.region
            for name in ("head", "frames", "tree", "hex", "faults", "car", "figures", "status")
            if (widget := screen.query_one(f"#{name}")).display
        ]
        if size not in SIZES:
            return  # too small to be of use; it only must not fail
        for at, region in enumerate(panes):
            assert screen.screen.region.contains_region(region)
            assert not any(region.overlaps(other) for other in panes[at + 1 :])
        assert screen.frames.room >= 2
        assert any("LED" in line for line in text_of(screen))
        assert {len(line) for line in text_of(screen)} == {size[0]}

    operated(screen, steps, size)


def test_where_the_fields_have_no_room_enter_shows_them_alone(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()))

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        def panes() -> list[bool]:
            return [bool(pane.display) for pane in (screen.frames, screen.fields)]

        await pilot.press("enter")
        assert (panes(), screen.fields.has_focus) == ([False, True], True)
        await pilot.press("escape")
        assert (panes(), screen.frames.has_focus) == ([True, False], True)
        await pilot.press("enter", "slash", "escape")
        assert (panes(), screen.frames.has_focus) == ([True, False], True)

    operated(screen, steps, (40, 10))


def test_a_filter_goes_on_with_the_rows_that_come(protocol: Protocol) -> None:
    test = compile_filter("direction == host", protocol)
    told = {"expression": "direction == host", "test": test}
    screen = browser(protocol, decoded(protocol, drive()), live=True, **told)

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        async def come(count: int, rows: int) -> None:
            for batch in decoded(protocol, drive(count)) if count else ():
                screen.feed.recording.add(batch)
            give_up = time.monotonic() + PATIENCE
            while screen.frames.count < rows and time.monotonic() < give_up:
                screen.tick()
                await pilot.pause(0.01)
            assert screen.frames.count == rows

        assert screen.filter_text == "direction == host"
        await come(0, 60)
        await come(5, 65)
        await come(10_001, 10_066)  # so many are filtered beside

    operated(screen, steps)


def test_panes_go_in_order_and_the_frames_last() -> None:
    def gone(width: int, height: int) -> list[str]:
        panes = arranged(width, height)._asdict()
        return [name for name in ("car", "figures", "faults", "tree", "hex") if not panes[name]]

    everything = ["car", "figures", "faults", "tree", "hex"]
    for width in range(10, 201, 5):
        for height in range(1, 61):
            missing = gone(width, height)
            assert missing == everything[: len(missing)] or width < 76
            panes = arranged(width, height)
            below = max(panes.tree, panes.hex) if panes.beside else panes.tree + panes.hex
            assert height < 10 or height - 2 - below - panes.faults >= 4
    assert gone(200, 60) == gone(80, 24) == []


def test_bytes_from_a_port_are_escaped_and_never_markup(protocol: Protocol) -> None:
    events = [Line(0, "break", "host", "[red]x[/red] \x1b]0;title\x07 [@click=app.exit]y[/]")]
    screen = browser(protocol, decoded(protocol, events))

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        shown = "\n".join(text_of(screen))
        assert "[red]x[/red]" in shown
        assert "\x1b" not in shown
        assert "\x07" not in shown

    operated(screen, steps)


def test_markup_of_a_grammar_is_shown_as_it_is(horn_text: str) -> None:
    protocol = load(horn_text.replace('9: "Horn"', '9: "Ho[/x][red]rn"'))
    screen = browser(protocol, decoded(protocol, [Chunk(0, "host", b"\x91\x03")]))

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await type_filter(pilot, "name == Ho")
        await pilot.pause()
        shown = "\n".join(text_of(screen))
        assert sum("Ho[/x][red]" in line for line in text_of(screen)) >= 3  # list, fields, prompt
        assert all(sign.isprintable() or sign == "\n" for sign in shown)

    operated(screen, steps)


def test_plain_signs_are_ascii(protocol: Protocol) -> None:
    screen = browser(protocol, decoded(protocol, drive()), signs=PLAIN)

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        await pilot.press("n", "m", "enter")
        assert "\n".join(text_of(screen)).isascii()
        for key in ("c", "x"):
            await pilot.press(key)
            assert "\n".join(text_of(screen)).isascii()
            await pilot.press("escape")
        await pilot.press("escape", "q")

    operated(screen, steps)


def test_an_error_of_the_feed_closes_the_screen_and_is_raised(protocol: Protocol) -> None:
    screen = browser(protocol, [])

    def fail(feed: Feed[None]) -> None:
        raise OSError("gone")

    screen.feed._work = fail

    async def steps(screen: Browser, pilot: Pilot[Any]) -> None:
        pass

    with pytest.raises(OSError, match="gone"):
        operated(screen, steps)


@pytest.mark.sample(2)
@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_text_does_nothing_to_the_screen(protocol: Protocol, name: str) -> None:
    evil = HOSTILE[name]
    events = [Line(0, evil, "", evil), *drive(5), Line(60 * MS, "unplugged", "host", evil)]
    screen = browser(protocol, decoded(protocol, events), expression=evil)
    screen.feed.notice = screen.feed.said = screen.feed.captured = evil
    shown: list[str] = []

    async def looked(screen: Browser, pilot: Pilot[Any]) -> None:
        for key in ("home", "down", "end", "question_mark"):
            await pilot.press(key)
            await pilot.pause()
            shown.extend(text_of(screen))

    operated(screen, looked, (160, 40))

    assert all(line.isprintable() for line in shown)
    assert any(printable(evil)[:8] in line for line in shown)
