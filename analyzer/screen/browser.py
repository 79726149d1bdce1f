"""The full screen: a list of frames, and panes about the chosen one and about the recording."""

from __future__ import annotations

import math
import shlex
import time
from asyncio import sleep
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import BindingType
from textual.containers import Horizontal, Vertical
from textual.driver import Driver
from textual.events import Event, Key, Paste
from textual.screen import Screen
from textual.scrollbar import ScrollBar, ScrollBarRender
from textual.widgets import Input, Static
from textual.worker import Worker, get_current_worker

from bilprov.analyzer.decode.records import DeviceRecord, HostRecord
from bilprov.analyzer.filters.completion import completions
from bilprov.analyzer.filters.filter import Filter, compile_filter
from bilprov.analyzer.grammar_file import grammar_words
from bilprov.analyzer.output.row_columns import RowStyle, TimeStyle
from bilprov.analyzer.replay.recorder import new_name
from bilprov.analyzer.screen.details import FieldTree
from bilprov.analyzer.screen.feeds import DRAW_EVERY, Feed, Told
from bilprov.analyzer.screen.frame_list import FrameList
from bilprov.analyzer.screen.keys import ALIASES, BINDINGS, Help
from bilprov.analyzer.screen.panes import figures, head_line, picture, status_line
from bilprov.analyzer.screen.prompt import REFUSAL, Prompt, Question, row_of
from bilprov.analyzer.screen.recording import View, export, new_file, rows_file
from bilprov.captures.text import printable, quantity
from bilprov.spec.codec import spaced

_SLICE = 0.03  # s of filtering after which keys and all else are handled
_FIGURES_EVERY = 0.5  # s
_QUIET = 10  # s without anything new, after which a file that is followed is called quiet
_DRAWING_SHARE = 0.05  # of the time, at most, that drawing what comes may take
_LONGEST_LAG = 1.0  # s that rows wait to be drawn, however long that takes
_SIDE_FROM = 110  # columns from which on the predicted state is drawn
_FAULTS = "faulty"
_STYLES: dict[TimeStyle, str] = {
    TimeStyle.RELATIVE: "seconds since the start",
    TimeStyle.ABSOLUTE: "the time of day here",
    TimeStyle.UTC: "the time of day in UTC",
}


class _WholeCells(ScrollBarRender):
    """Scroll bars without the signs for parts of a cell, which need colours of their own."""

    VERTICAL_BARS: ClassVar[list[str]] = [" "]


class Browser(App[str | None]):
    """The screen over a feed. Its result is the file to keep the recording in, None for none.

    It closes by itself once it is `interrupted`.
    """

    ENABLE_COMMAND_PALETTE = False
    # Textual's own annotation keeps a type checker from taking these for class variables.
    HORIZONTAL_BREAKPOINTS = [(0, "-narrow"), (_SIDE_FROM, "-wide"), (160, "-huge")]  # noqa: RUF012
    VERTICAL_BREAKPOINTS = [(0, "-low"), (14, "-short"), (20, "-usual"), (30, "-high")]  # noqa: RUF012
    CSS_PATH = "browser.tcss"
    SCREENS: ClassVar[dict[str, Callable[[], Screen[Any]]]] = {"help": Help}
    BINDINGS: ClassVar[list[BindingType]] = [*BINDINGS]

    def __init__(
        self,
        feed: Feed,
        told: Told,
        interrupted: Callable[[], bool] = lambda: False,
        driver_class: type[Driver] | None = None,
    ) -> None:
        super().__init__(driver_class=driver_class, ansi_color=True)
        self.theme = "ansi-dark"
        ScrollBar.renderer = _WholeCells
        self.animation_level = "none"
        self.title = "bilprov"
        self.feed = feed
        self.told = told
        self.interrupted = interrupted
        self.follows = feed.live
        self._sought: Callable[[], int] | None = None  # a place to go to once all rows are read
        self._leaving = False  # whether the prompt asks where to keep what would be lost
        self.filter_text = ""
        self.said = ""
        self._recording = feed.recording
        self._playing: Callable[[], int] | None = None  # the time (ns) that has come
        self._typed = ""  # the digits before a key
        self._shown: tuple[object, ...] = ()
        self._drawn_at, self._used_at = 0.0, time.thread_time()
        self.frames = FrameList(feed.recording, told.rows, told.start_wall, self._chosen)
        self.fields = FieldTree(feed.recording.protocol)
        self.prompt = Prompt(self._left_prompt)
        panes = [Static(id=name, markup=False) for name in ("head", "status", "car", "figures")]
        self.head, self.status, self.car, self.figures = panes

    def compose(self) -> ComposeResult:
        """The panes; the style sheet says which are shown."""
        yield self.head
        with Horizontal(id="body"):
            with Vertical(id="main"):
                yield self.frames
                yield self.fields
            with Vertical(id="side"):
                yield self.car
                yield self.figures
        yield self.prompt
        yield self.status

    def on_mount(self) -> None:
        """Begin."""
        self.screen.set_focus(self.frames)  # at once: what was typed ahead may be a filter
        self.car.display = bool(self._recording.protocol.variables)
        if self._recording.rows:  # the first page is not to wait for the rest
            self.call_after_refresh(self.feed.start)
        else:  # a line, which waits for nobody
            self.feed.start()
        self.set_interval(DRAW_EVERY, self.tick)
        self.set_interval(_FIGURES_EVERY, self._show_figures)
        self.call_after_refresh(self._show_figures)
        if self.told.test is not None:
            self._filter(self.told.expression, self.told.test)
        self.tick()
        # Draw the next rows as soon as they come, however long the first layout took.
        self.call_after_refresh(setattr, self, "_drawn_at", -math.inf)

    @property
    def failure(self) -> Exception | None:
        """What made the screen fail, None where nothing did."""
        return self._exception

    def _fatal_error(self) -> None:
        """End; whoever shows the screen reports why. Textual would print a thousand lines."""
        self._close_messages_no_wait()

    # What happens by itself.

    def tick(self) -> None:
        """See what has come since the last time, and show it unless drawing takes too much."""
        if self.feed.closes or self.interrupted():
            self.exit(None)
            return
        view, sought = self.frames.view, self._sought
        if not self._working("filter") and not view.catch_up(_SLICE):
            self._look(self.filter_text, view)
        if sought and self.feed.ended:
            self._go_to(sought)
        self._play()
        if self._now() != self._shown and self._may_draw():
            self.show_rows()
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
        self._show_bars()

    def _may_draw(self) -> bool:
        """Whether drawing has not taken too large a share of the time since it was last done.

        Who reads a line needs the time; what keys ask for is drawn at once all the same.
        """
        now, used = time.monotonic(), time.thread_time()
        if now - self._drawn_at < min((used - self._used_at) / _DRAWING_SHARE, _LONGEST_LAG):
            return False
        self._drawn_at, self._used_at = now, used
        return True

    def _now(self) -> tuple[object, ...]:
        view = self.frames.view
        return id(view), view.first, view.count, self._recording.first

    def _play(self) -> None:
        """Choose the row that it is time for, while the capture is played."""
        if self._playing is None:
            return
        frames, last = self.frames, self.frames.count - 1
        row = last
        if self.told.rate:
            due = self._recording.row_at(self._playing() + 1)
            row = min(frames.view.position(due) - 1, last)
        if row > frames.cursor:
            frames.choose(row)
            self._show_row()
        if self.feed.ended and row >= last:
            self._playing = None

    def _pace(self) -> Callable[[], int] | None:
        """The clock of a capture that is played from the chosen row on; None without rows."""
        record, since, rate = self.frames.record, time.monotonic(), self.told.rate
        if record is None:
            return None
        return lambda: record.t + round((time.monotonic() - since) * rate * 1e9)

    def _filter(self, text: str, test: Filter | None) -> None:
        """Show the rows that pass, once they are found; until then those from before."""
        self.workers.cancel_group(self, "filter")
        self._look(text, View(self._recording, test))

    def _look(self, text: str, view: View) -> None:
        """Show the rows of a view at once, or when all rows were looked at."""
        if view.catch_up(_SLICE):
            self.filter_text = text
            self.frames.look_at(view)
            self.show_rows()
        else:
            self.run_worker(self._looked(text, view), group="filter", name="filter")

    async def _looked(self, text: str, view: View) -> None:
        """Look at all rows, with keys and all else between."""
        while not view.catch_up(_SLICE):
            _progress(view.seen / self._recording.rows)
            await sleep(0)
        self._look(text, view)

    def _working(self, *groups: str) -> Worker[None] | None:
        """The worker of these groups that runs, if any."""
        running = (worker for worker in self.workers if worker.is_running)
        return next((worker for worker in running if worker.group in groups), None)

    # The panes.

    def _show_row(self) -> None:
        """Show all about the chosen row."""
        record = self.frames.record
        self.fields.show(record, state=self.size.width < _SIDE_FROM)
        self.frames.lit = self.fields.bytes
        protocol = self._recording.protocol
        lines = picture(protocol, record.state if record else protocol.power_on)
        self._write(self.car, Text("\n", no_wrap=True).join(lines))

    def _show_figures(self) -> None:
        if width := self.figures.size.width:
            totals, live = self._recording.totals, self.feed.rates
            lines = figures(totals, live, self.told.line.byte_time, width)
            self._write(self.figures, Text("\n", no_wrap=True).join(lines))

    def _show_bars(self) -> None:
        """Write the line above the panes, and the one below them."""
        feed, width = self.feed, self.size.width
        doing = "following" if self.follows else ""
        quiet = time.monotonic() - feed.grew if feed.grew else 0
        if doing and quiet >= _QUIET:  # whether a killed writer or a quiet line, nobody can tell
            doing += f", quiet for {quiet:.0f} s"
        if self._playing:
            doing = f"playing {self._playing() / 1e9:.1f} s"
        head = head_line(self.told, feed, self.frames, doing, self.filter_text, width)
        self._write(self.head, head)
        work = self._working("filter", "export")
        doing = f"{work.name} {work.progress or 0:.0f}%" if work else ""
        self._write(self.status, status_line(doing, feed, self.said, width))

    def _write(self, pane: Static, text: Text) -> None:
        """Write a text into a pane, where it is another one than before: drawing takes time."""
        before = pane.content
        if before != text:
            # What has as many lines as before needs no new layout of the whole screen.
            lines = before.plain.count("\n") if isinstance(before, Text) else -1
            pane.update(text, layout=lines != text.plain.count("\n"))

    def _say(self, sentence: str) -> None:
        self.said = sentence
        self._show_bars()

    # What people do.

    async def on_event(self, event: Event) -> None:
        """Handle a key or a paste before the next one, so that each goes where it was meant.

        Textual hands a key to the pane that has the focus, which handles it later: behind a key
        that moves the focus the next ones would still go to the pane before.
        """
        if isinstance(event, Key) and not event.is_forwarded and await self._handled(event):
            return
        if isinstance(event, Paste) and not event.is_forwarded and self._pasted(event.text):
            return
        await super().on_event(event)

    async def _handled(self, key: Key) -> bool:
        """Handle a key here and now; returns whether anything did."""
        if self.focused is None and not self.is_modal:
            self.screen.set_focus(self.frames)  # its pane has gone from a screen made smaller
        if await self._check_bindings(key.key, priority=True):
            return True
        if isinstance(self.focused, Input):
            if key.character and key.is_printable:
                self.focused.replace(key.character, *self.focused.selection)
                return True
            return await self._check_bindings(key.key)
        if key.key.isdigit() and (self._typed or key.key != "0"):
            self._typed += key.key
            return True
        self.frames.repeat = self.fields.repeat = int(self._typed or 0) or None
        self._typed, self._sought = "", None
        if await self._check_bindings(key.key):
            return True
        return key.key in ALIASES and await self._check_bindings(ALIASES[key.key])

    def _pasted(self, text: str) -> bool:
        """Paste into the line that is being typed; without one, a paste is a filter."""
        line = " ".join(text.splitlines())
        if self.screen.is_modal:
            return False
        if not isinstance(self.focused, Input):
            self.action_filter()
            line = line.removeprefix("/")
        self.prompt.line.replace(line, *self.prompt.line.selection)
        return True

    def _chosen(self) -> None:
        """Show the row that was chosen by hand; a capture is played from there on."""
        self.said, self._sought = "", None
        self.follows = self.follows and self.frames.cursor >= self.frames.count - 1
        self._playing = self._playing and self._pace()
        self._show_row()
        self._show_bars()

    def action_fields(self) -> None:
        """Go from a frame to its fields, which are shown alone where there is no room."""
        if self.frames.record is not None:
            self.screen.add_class("zoomed")
            self.screen.set_focus(self.fields)
            self.on_tree_node_highlighted()

    def on_tree_node_highlighted(self) -> None:
        """Mark the bytes of the field in the list."""
        self.frames.lit = self.fields.bytes
        self.frames.refresh()

    def _ask(self, question: Question, text: str = "", *, replaced: bool = False) -> None:
        self.screen.remove_class("zoomed")
        self.status.display = False
        self.prompt.ask(question, text, replaced=replaced)

    def _left_prompt(self) -> None:
        self._leaving = False
        self.status.display = True
        self.screen.set_focus(self.frames)

    def action_filter(self) -> None:
        """Ask for a filter, whose rows are seen then."""
        protocol, start = self._recording.protocol, self.told.start_wall

        def read(text: str) -> tuple[str, Filter | None]:
            return text, compile_filter(text, protocol).started(start) if text else None

        hint = "Tab completes, Enter filters, Esc goes back"
        question = Question("filter /", hint, read, lambda found: self._filter(*found))
        offered = partial(completions, protocol=protocol)
        self._ask(question._replace(completions=offered), self.filter_text, replaced=True)

    def action_only_faults(self) -> None:
        """Show only the rows with a fault; where they are shown, all rows."""
        text = "" if self.filter_text == _FAULTS else _FAULTS
        self._filter(text, compile_filter(text, self._recording.protocol) if text else None)

    def action_fault(self, step: int) -> None:
        """Go to the next fault, or to the one before."""
        view, row = self.frames.view, self.frames.row
        for _ in range(self.frames.repeat or 1):
            row = None if row is None else view.fault(row, step)
            if row is None or view.position(row) >= self.frames.count:
                self._say(f"no fault comes {'after' if step > 0 else 'before'} this")
                return
            self._show_at(row)

    def action_go(self) -> None:
        """Ask for a row or a time, and go there."""
        utc = self.frames.time_style is TimeStyle.UTC
        start, row_at = self.told.start_wall, self._recording.row_at

        def read(text: str) -> Callable[[], int]:
            place = partial(row_of, text, start, utc, row_at)
            place()  # raises ValueError
            return place

        self._ask(Question("go to :", f"{REFUSAL}; Esc goes back", read, self._go_to))

    def action_go_to_number(self, number: int) -> None:
        """Go to the row of this number, or of the one that was typed; 0 stands for the last."""
        number = self.frames.repeat or number
        follows = self.follows and not number
        self._go_to(partial(int, number - 1) if number else self._last)
        self.follows = follows

    def _last(self) -> int:
        return max(0, self._recording.rows - 1)

    def _go_to(self, place: Callable[[], int]) -> None:
        """Go to the row that a place is; while rows are read, once more when all of them are."""
        reading = not (self.feed.live or self.feed.ended)
        row = place()
        self._show_at(row)
        if reading:
            self._sought = place
        elif row > self._last():
            self._say("the recording ends before that: this is its last row")

    def _show_at(self, row: int) -> None:
        self.frames.choose(self.frames.view.position(row))
        self.follows = False
        self._chosen()

    def action_pause(self) -> None:
        """Hold the view of a line still, or go on; play a capture, or stop."""
        if not self.feed.live:
            self._playing = self._pace() if self._playing is None else None
            self._show_bars()
            return
        self.show_rows()
        self.frames.held = self._recording.rows if self.frames.held is None else None
        self.show_rows()

    def action_follow(self) -> None:
        """Follow what comes, or stop to."""
        self.follows = not self.follows or self.frames.held is not None
        if self.follows:
            self.frames.held = None
        self.show_rows()

    def action_times(self) -> None:
        """Show times in the next style."""
        styles = list(_STYLES)
        style = styles[(styles.index(self.frames.time_style) + 1) % len(styles)]
        self.frames.time_style = style
        self.frames.changed()
        self._say(f"time: {_STYLES[style]}")

    def action_reference(self) -> None:
        """Count times from the chosen row, or from the start again."""
        record = self.frames.record
        if record is not None:
            self.frames.reference = 0 if record.t == self.frames.reference else record.t
            self.frames.time_style = TimeStyle.RELATIVE
            self.frames.changed()
            self._say(f"times count from {self.frames.reference / 1e9:.6f} s")

    def action_copy(self) -> None:
        """Copy the chosen frame, or the one that is answered, as a command line that sends it."""
        record = self.frames.record
        data = record.data if isinstance(record, HostRecord) else b""
        if isinstance(record, DeviceRecord) and record.answered:
            data = record.answered.frame
        if data:
            grammar = shlex.join(grammar_words(self._recording.protocol))
            line = f"bilprov send PORT '{spaced(data)}' {grammar}".rstrip()
            self.copy_to_clipboard(line)
            self._say(f"copied: {line}")
        else:
            self._say("there is no frame to copy in this row")

    def action_export(self) -> None:
        """Ask for a file, and write the rows of the view into it."""

        def write(name: str) -> None:
            self.run_worker(self._exported(name), group="export", name="export")

        rows = quantity(self.frames.view.count - self.frames.view.first, "row")
        hint = "NAME.csv or NAME.jsonl; Enter writes it, Esc goes back"
        question = Question(f"write {rows} to", hint, rows_file, write)
        if not self._working("export"):
            self._ask(question, "rows.csv", replaced=True)

    async def _exported(self, name: str) -> None:
        """Write the rows of the view into a file, with keys and all else between."""
        view, columns, rows = self.frames.view, self.told.rows.columns, 0
        style = RowStyle(self.frames.time_style if columns else None, columns)
        try:
            for rows in export(self._recording, view, name, style, self.told.start_wall):
                _progress(rows / max(1, view.count - view.first))
                await sleep(0)
            self._say(f"{quantity(rows, 'row')} written to {printable(name)}")
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            self._say(f"{printable(name)} cannot be written ({printable(why)})")

    def action_go_back(self) -> None:
        """Go back from where one is, or stop what takes long."""
        self.said = self.feed.notice = ""
        if self.prompt.display:
            self.prompt.leave()
        elif self.workers.cancel_group(self, "filter"):
            self._say("the filter was stopped: the rows are those from before")
        elif self.workers.cancel_group(self, "export"):
            self._say("the export was stopped: nothing is written")
        self.screen.remove_class("zoomed")
        self.screen.set_focus(self.frames)

    def action_leave(self) -> None:
        """Quit; ask once before, where the recording would be lost."""
        rows = self._recording.rows
        if self._leaving or not (self.feed.keeps and rows):
            self.exit(None)
            return
        while self.screen.is_modal:
            self.pop_screen()
        self._leaving = True
        label = f"Save the capture of {quantity(rows, 'row')} as"
        hint = "Enter saves it and leaves, Ctrl-C discards it, Esc goes back"
        self._ask(Question(label, hint, new_file, self.exit), new_name(), replaced=True)


def _progress(share: float) -> None:
    """Tell how much a worker has done."""
    get_current_worker().update(completed_steps=round(share * 100), total_steps=100)
