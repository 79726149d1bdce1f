"""The full screen: a list of frames, and panes about the chosen one and about the recording."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Thread
from typing import Any, ClassVar, TypeVar

from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import BindingType
from textual.containers import Container, Horizontal, Vertical
from textual.driver import Driver
from textual.events import Event, Key, Resize
from textual.geometry import Size
from textual.screen import ModalScreen
from textual.widgets import Input, Static

from bilprov.analyzer.filters.filter import Filter
from bilprov.analyzer.output.row_columns import RowStyle, Times, TimeStyle, columns_of
from bilprov.analyzer.screen.arrangement import SIDE_WIDTH, arranged
from bilprov.analyzer.screen.bars import head_line, status_line
from bilprov.analyzer.screen.car import car
from bilprov.analyzer.screen.detail_panes import FieldTree, HexPane
from bilprov.analyzer.screen.dialogs import AskName, Choice, ColumnChoice, Help
from bilprov.analyzer.screen.feeds import DRAW_EVERY, Feed
from bilprov.analyzer.screen.figures import figures
from bilprov.analyzer.screen.filtering import Filtering
from bilprov.analyzer.screen.frame_list import WHAT, FaultList, FrameList
from bilprov.analyzer.screen.keys import ABOUT, BINDINGS, KEYS
from bilprov.analyzer.screen.prompt import LINES, FilterPrompt
from bilprov.analyzer.screen.row_export import RowExport, new_file_refusal, refusal
from bilprov.analyzer.screen.rows import Rows
from bilprov.analyzer.screen.signs import FINE, Signs
from bilprov.captures.schemas import State
from bilprov.captures.text import quantity

Answer = TypeVar("Answer")

_SOON = 20_000  # rows that are filtered at once; more take a thread
_FIGURES_EVERY = 0.5  # s
_DRAWING_SHARE = 0.08  # of the time, at most, that drawing what comes may take


@dataclass(frozen=True, slots=True)
class _Pace:
    """The pace at which a capture is played: from `t` (ns) on since the clock showed `since` s."""

    t: int
    since: float
    rate: float

    @property
    def now(self) -> int:
        """The time of the capture (ns) that has come."""
        return self.t + round((time.monotonic() - self.since) * self.rate * 1e9)


@dataclass(frozen=True, slots=True)
class Told:
    """What the screen shows beside the rows.

    `title` names the file or the ports, `start_wall` is the wall clock (ns since 1970) at t = 0,
    `byte_time` ns a byte on the line. `expression` and `test` are the filter to begin with. A
    capture is played `rate` times as fast as it was recorded, at 0 without pauses.
    """

    title: str
    start_wall: int
    byte_time: int
    rows: RowStyle = field(default_factory=RowStyle)
    expression: str = ""
    test: Filter | None = None
    rate: float = 1.0


class Browser(App[str | None]):
    """The screen over a feed. Its result is the file to keep the recording in, None for none.

    It closes by itself once it is `interrupted`.
    """

    ENABLE_COMMAND_PALETTE = False
    CSS = """
    Screen { layout: vertical; background: ansi_default; color: ansi_default; }
    ModalScreen { background: transparent; }
    #head, #status { height: 1; width: 100%; }
    #body { height: 1fr; }
    #main { width: 1fr; height: 100%; }
    #side { width: 30; height: 100%; padding-left: 1; }
    #details { height: auto; }
    #frames, #tree, #faults, #hex, #car, #figures {
        border-top: solid ansi_blue; border-title-color: ansi_default;
    }
    .plain #frames, .plain #tree, .plain #faults, .plain #hex, .plain #car, .plain #figures {
        border-top: ascii ansi_blue;
    }
    #car, #figures { text-wrap: nowrap; }
    #frames:focus, #tree:focus, #faults:focus { border-title-style: bold reverse; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [*BINDINGS]

    def __init__(
        self,
        feed: Feed[Any],
        told: Told,
        signs: Signs = FINE,
        interrupted: Callable[[], bool] = lambda: False,
        driver_class: type[Driver] | None = None,
    ) -> None:
        super().__init__(driver_class=driver_class, ansi_color=True)
        self.theme = "ansi-dark"
        self.title = "bilprov"
        self.feed = feed
        self.told = told
        self.signs = signs
        self.interrupted = interrupted
        self.follows = feed.live
        self.filter_text = ""
        self.said = ""
        self._recording = feed.recording
        self.filtering: Filtering | None = None
        self.export: RowExport | None = None
        self._catching_up: Thread | None = None
        self._playing: _Pace | None = None
        self._zoomed = False
        self._figures_at = 0.0
        self._shown: tuple[object, ...] = ()
        self._drawn_at, self._used_at = 0.0, time.thread_time()
        self._written: dict[Static, Text] = {}
        self.frames = FrameList(feed.recording, told.rows, told.start_wall, signs)
        self.fields = FieldTree(feed.recording.protocol, signs)
        self.hex = HexPane()
        self.faults = FaultList(feed.recording, signs)
        self.prompt = FilterPrompt(
            feed.recording.protocol, told.start_wall, self._filter_given, self._left_prompt
        )
        self.head, self.status = (Static(id=name, markup=False) for name in ("head", "status"))
        self.car, self.figures = (Static(id=name, markup=False) for name in ("car", "figures"))
        self.car.border_title, self.figures.border_title = "predicted", "line"

    def compose(self) -> ComposeResult:
        """The panes; `_arrange` says which are shown."""
        yield self.head
        with Horizontal(id="body"):
            with Vertical(id="main"):
                yield self.frames
                with Container(id="details"):
                    yield self.fields
                    yield self.hex
                yield self.faults
            with Vertical(id="side"):
                yield self.car
                yield self.figures
        yield self.prompt
        yield self.status

    def on_mount(self) -> None:
        """Begin."""
        if self.signs is not FINE:
            self.screen.add_class("plain")
        self.frames.focus()
        self._arrange()
        self.feed.start()
        self.set_interval(DRAW_EVERY, self.tick)
        if self.told.test is not None:
            self._filter(self.told.expression, self.told.test)
        self.tick()

    def on_unmount(self) -> None:
        """End what still runs."""
        for work in (self.filtering, self.export):
            if work:
                work.cancel()

    def on_resize(self, event: Resize) -> None:
        """Show the panes that fit the new size, which the app does not have yet."""
        self._arrange(event.size)

    # What happens by itself.

    def tick(self) -> None:
        """See what has come since the last time, and show it unless drawing takes too much."""
        if self.feed.closes or self.interrupted():
            self.exit(None)
            return
        self._catch_up()
        self._play()
        if self._now() != self._shown and self._may_draw():
            self.show_rows()
        if time.monotonic() >= self._figures_at:
            self._figures_at = time.monotonic() + _FIGURES_EVERY
            self._show_figures()
        if self.export and self.export.ended:
            self.said, self.export = self.export.said, None
        self._show_bars()

    def show_rows(self) -> None:
        """Show the rows that have come, unless the view is paused."""
        frames = self.frames
        self._shown = self._now()
        if frames.held is None:
            if self.follows:
                frames.choose(frames.count - 1)
            else:
                frames.changed()
            self._show_row()
            self.faults.changed()
        self._show_bars()

    def _play(self) -> None:
        """Choose the row that it is time for, while the capture is played."""
        if self._playing is None:
            return
        last = self.frames.count - 1
        row = last if not self.told.rate else self.frames.position_at(self._playing.now)
        if row > self.frames.cursor:
            self.frames.choose(row)
            self._show_row()
        if self.feed.ended and row >= last:
            self._playing = None

    def _play_from_here(self) -> None:
        """Go on from the row that was chosen by hand, where the capture is played."""
        if self._playing is not None:
            self._playing = self._pace()

    def _pace(self) -> _Pace | None:
        """The pace from the chosen row on; None without rows."""
        record = self.frames.record
        return None if record is None else _Pace(record.t, time.monotonic(), self.told.rate)

    def _may_draw(self) -> bool:
        """Whether drawing has not taken too large a share of the time since it was last done.

        Who reads a line needs the time; what keys ask for is drawn at once all the same.
        """
        now, used = time.monotonic(), time.thread_time()
        if now - self._drawn_at < (used - self._used_at) / _DRAWING_SHARE:
            return False
        self._drawn_at, self._used_at = now, used
        return True

    def _now(self) -> tuple[object, ...]:
        view = self.frames.view
        return id(view), view.first, view.count, self._recording.first

    def _catch_up(self) -> None:
        """Filter the rows that are new: a few here, many in a thread."""
        filtering = self.filtering
        if filtering and filtering.ended:
            self.filtering = None
            if not filtering.cancelled.is_set():
                self.filter_text = filtering.text
                self.frames.look_at(filtering.view)
                self._show_row()
        view = self.frames.view
        if self._catching_up and self._catching_up.is_alive():
            return
        if 0 < view.behind <= _SOON:
            view.catch_up()
        elif view.behind:
            self._catching_up = Thread(target=view.catch_up, name="filter", daemon=True)
            self._catching_up.start()

    # The panes.

    def _arrange(self, size: Size | None = None) -> None:
        """Give each pane its place, or hide it."""
        size = size or self.size
        more = LINES - 1 if self.prompt.display else 0
        panes = arranged(*size, more, zoomed=self._zoomed)
        shown = {
            "side": panes.side,
            "car": panes.car,
            "figures": panes.figures,
            "faults": panes.faults,
            "tree": panes.tree,
            "hex": panes.hex,
            "details": max(panes.tree, panes.hex),
            "frames": not self._zoomed,
            "status": size.height > 1 and not self.prompt.display,
        }
        for name, lines in shown.items():
            self.query_one(f"#{name}").display = bool(lines)
        for name in ("car", "faults", "tree", "hex"):
            self.query_one(f"#{name}").styles.height = shown[name]
        self.query_one("#side").styles.width = SIDE_WIDTH
        beside = panes.beside > 0
        details = self.query_one("#details")
        details.styles.layout = "horizontal" if beside else "vertical"
        details.styles.height = panes.tree if beside else panes.tree + panes.hex
        self.hex.styles.width = panes.beside if beside else "1fr"

    def _show_row(self) -> None:
        """Show all about the chosen row."""
        record = self.frames.record
        self.fields.show(record)
        self.hex.show(record, self.fields.group)
        row = self.frames.row
        if row is not None and not self.faults.has_focus:
            self.faults.follow(row)
        protocol = self._recording.protocol
        state = record.state if record else State("stopped", 0, 0, 0, moving=False)
        self._write(self.car, Text("\n", no_wrap=True).join(car(protocol, state, self.signs)))

    def _show_figures(self) -> None:
        if self.figures.display:
            lines = figures(
                self._recording.totals, self.feed.rates, self.told.byte_time, self.signs
            )
            self._write(self.figures, Text("\n", no_wrap=True).join(lines))

    def _show_bars(self) -> None:
        """Write the line above the panes, and the one below them."""
        feed, width = self.feed, self.size.width
        title, work = self.told.title, self.filtering or self.export
        doing = "following" if self.follows else ""
        if self._playing:
            doing = f"playing {self._playing.now / 1e9:.1f} s"
        self._write(self.head, head_line(title, feed, self.frames, doing, width))
        doing = work.doing if work else ""
        self._write(self.status, status_line(doing, feed, self.said, self.filter_text, width))

    def _write(self, pane: Static, text: Text) -> None:
        """Write a text into a pane, where it is another one than before: drawing takes time."""
        if self._written.get(pane) != text:
            self._written[pane] = text
            pane.update(text)

    # What people do.

    async def on_event(self, event: Event) -> None:
        """Handle a key before the next one, so that keys typed ahead go where they were meant.

        Textual hands a key to the pane that has the focus, which handles it later: behind a key
        that moves the focus the next ones would still go to the pane before.
        """
        if isinstance(event, Key) and not event.is_forwarded and await self._handled(event):
            return
        await super().on_event(event)

    async def _handled(self, key: Key) -> bool:
        """Handle a key here and now; returns whether anything did."""
        if await self._check_bindings(key.key, priority=True):
            return True
        if isinstance(self.focused, Input) and key.character and key.is_printable:
            self.focused.replace(key.character, *self.focused.selection)
            return True
        return await self._check_bindings(key.key)

    def on_rows_chosen(self, event: Rows.Chosen) -> None:
        """Show what was chosen."""
        self.said = ""
        if event.rows is self.frames:
            self.follows = self.follows and self.frames.cursor >= self.frames.count - 1
            self._play_from_here()
            self._show_row()
        elif event.rows is self.fields:
            self.hex.show(self.frames.record, self.fields.group)
        self._show_bars()

    def on_rows_entered(self, event: Rows.Entered) -> None:
        """Go from a frame to its fields, and from a fault to its frame."""
        if event.rows is self.frames:
            if not self.fields.display:
                self._zoom(True)
            self.screen.set_focus(self.fields)
        elif event.rows is self.faults and self.faults.row is not None:
            self._go_to(self.faults.row)
            self.screen.set_focus(self.frames)

    def on_hex_pane_clicked(self, event: HexPane.Clicked) -> None:
        """Choose the field of a bit."""
        self.fields.find(event.byte, event.bit)
        self.hex.show(self.frames.record, self.fields.group)

    def action_filter(self) -> None:
        """Ask for a filter, whose rows are seen then."""
        self._zoomed = False
        self.prompt.ask(self.filter_text)
        self._arrange()

    def _filter_given(self, text: str, test: Filter | None) -> None:
        self._left_prompt()
        self._filter(text, test)

    def _left_prompt(self) -> None:
        self.screen.set_focus(self.frames)
        self._arrange()

    def _filter(self, text: str, test: Filter | None) -> None:
        """Show the rows that pass, once they are found."""
        if self.filtering:
            self.filtering.cancel()
        self.said = ""
        self.filtering = Filtering(self._recording, text, test)
        self.filtering.thread.join(0.05)  # mostly it is done by then, and shown at once
        self.tick()

    def action_fault(self, step: int) -> None:
        """Go to the next fault, or to the one before."""
        row = self.frames.row
        view = self.frames.view
        if row is None:
            return
        found = view.next_fault(row) if step > 0 else view.fault_before(row)
        if found is None or view.position(found) >= self.frames.count:
            self._say("no fault comes after this" if step > 0 else "no fault comes before this")
        else:
            self._go_to(found)

    def action_pause(self) -> None:
        """Hold the view of a line still, or go on; play a capture, or stop."""
        if not self.feed.live:
            self._playing = self._pace() if self._playing is None else None
            self._show_bars()
            return
        self.show_rows()
        self._hold(self._recording.rows if self.frames.held is None else None)
        self.show_rows()

    def action_follow(self) -> None:
        """Follow what comes, or stop to."""
        self.follows = not self.follows or self.frames.held is not None
        if self.follows:
            self._hold(None)
        self.show_rows()

    def _hold(self, rows: int | None) -> None:
        """Show the first rows of the recording, so many of them; all if None."""
        self.frames.held = self.faults.held = rows

    def action_mark(self) -> None:
        """Mark the chosen row, or take its mark away."""
        row = self.frames.row
        if row is not None:
            self.frames.marks ^= {row}
            self.frames.changed()

    def action_next_mark(self) -> None:
        """Go to the next mark; after the last one, to the first."""
        row = self.frames.row
        marks = sorted(mark for mark in self.frames.marks if mark >= self._recording.first)
        if row is None or not marks:
            self._say("no row is marked: m marks one")
            return
        self._go_to(next((mark for mark in marks if mark > row), marks[0]))

    def action_times(self) -> None:
        """Show times in the next style."""
        styles = list(TimeStyle)
        style = styles[(styles.index(self.frames.time_style) + 1) % len(styles)]
        self.frames.time_style = style
        self.frames.changed()
        self._say(f"times: {_TIMES[style]}")

    def action_columns(self) -> None:
        """Ask which columns are shown."""
        known = {WHAT.name: WHAT} | columns_of(self._recording.protocol)
        known = {"time": known.pop("time")} | known
        chosen = self.frames.columns

        def choose(names: list[str] | None) -> None:
            if names is not None:
                self.frames.columns = tuple(known[name] for name in names) or None
                self.frames.changed()

        shown = [column.name for column in chosen] if chosen else ["time", "hex", "what", "reason"]
        says = {name: column.says for name, column in known.items()}
        self._ask(ColumnChoice(says, shown, self.signs), choose)

    def action_export(self) -> None:
        """Ask for a file, and write the rows of the view into it."""
        if self.export:
            return
        rows = self.frames.view.count - self.frames.view.first

        def write(name: str | None) -> None:
            if name:
                columns = self.frames.columns
                known = tuple(c for c in columns if c is not WHAT) if columns else None
                times = Times(self.frames.time_style, self.told.start_wall)
                view = self.frames.view
                self.export = RowExport(self._recording, view, name, known, times)

        question = f"Export {quantity(rows, 'row')} to a new file, NAME.csv or NAME.jsonl:"
        self._ask(AskName(question, "rows.csv", refusal), write)

    def action_keys(self) -> None:
        """Show the help."""
        self._ask(Help(KEYS, ABOUT), lambda answer: None)

    def action_go_back(self) -> None:
        """Go back from where one is, or stop what takes long."""
        self.said = ""
        if self.prompt.display:
            self.prompt.leave()
        elif self.filtering:
            self.filtering.cancel()
            self._say("the filter was stopped: the rows are those from before")
        elif self.export:
            self.export.cancel()
        elif self._zoomed:
            self._zoom(False)
        self.screen.set_focus(self.frames)

    def action_leave(self) -> None:
        """Quit; ask before, where the recording would be lost."""
        if not (self.feed.keeps and self._recording.rows):
            self.exit(None)
            return
        answers = {"y": "yes, save it", "n": "no, discard it", "Esc": "go back to the screen"}

        def answer(key: str | None) -> None:
            if key == "y":
                self._ask(AskName("Save the capture as:", self._proposed(), new_file_refusal), save)
            elif key == "n":
                self.exit(None)

        def save(name: str | None) -> None:
            if name:
                self.exit(name)

        rows = self._recording.rows
        self._ask(Choice(f"Save the capture of {quantity(rows, 'row')}?", answers), answer)

    def action_end(self) -> None:
        """Quit without a question, as Ctrl-C does everywhere."""
        self.exit(None)

    def _proposed(self) -> str:
        return time.strftime("capture-%Y%m%d-%H%M%S.mcap", time.localtime())

    def _ask(self, dialog: ModalScreen[Answer], then: Callable[[Answer | None], None]) -> None:
        if self.signs is not FINE:
            dialog.add_class("plain")
        self.push_screen(dialog, then)

    def _go_to(self, row: int) -> None:
        self.follows = False
        self.frames.go_to(row)
        self._play_from_here()
        self._show_row()
        self._show_bars()

    def _zoom(self, zoomed: bool) -> None:
        """Show the fields alone, or all panes."""
        self._zoomed = zoomed
        self._arrange()

    def _say(self, sentence: str) -> None:
        self.said = sentence
        self._show_bars()


_TIMES = {
    TimeStyle.RELATIVE: "seconds since the start",
    TimeStyle.DELTA: "seconds since the row before",
    TimeStyle.ABSOLUTE: "date and time of day here",
    TimeStyle.UTC: "date and time of day in UTC",
}
