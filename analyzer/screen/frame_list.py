"""The list of frames: the rows of a view, of which only those on the screen are ever made."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import ClassVar

from rich.text import Text
from textual import events
from textual.binding import Binding, BindingType
from textual.geometry import Size
from textual.scroll_view import ScrollView
from textual.strip import Strip

from bilprov.analyzer.decode.json_lines import json_line
from bilprov.analyzer.decode.records import (
    DeviceRecord,
    FaultRecord,
    HostRecord,
    LineRecord,
    Record,
)
from bilprov.analyzer.output.row_columns import COLUMNS, TIME, Column, RowStyle, Times, TimeStyle
from bilprov.analyzer.output.text_lines import hex_width
from bilprov.analyzer.screen.keys import CUT, NEITHER, TO_DEVICE, TO_HOST, Look, look_of
from bilprov.analyzer.screen.recording import Recording, View
from bilprov.captures.text import printable
from bilprov.spec.fields import Outcome

NO = Column("no", "no", 6, lambda line: "", right=True)  # of the row
DELTA = Column("delta", "+ms", 8, lambda line: "", right=True)  # since the row above
ARROW = Column("arrow", "", 1, lambda line: "")  # to the device, or from it
WHAT = Column("what", "what", 36, lambda line: "")  # the frame or the answer in words
BYTES = COLUMNS["hex"]._replace(heading="bytes")
OWN = {column.name: column for column in (NO, TIME, DELTA, ARROW, BYTES, WHAT)}
"""The usual columns."""

_LEAST = {DELTA.name: 59, NO.name: 49}  # columns of the screen from which on these are shown
_LENT = 6  # columns of what a row is that longer frames may take
_WORDY = 36  # columns more than usual that the words and the reason of a fault take
_LATE = 13  # columns of an answer's name
_LATENCY = 11  # columns of a latency, which is shown where all of it has room
_ROOMY = 45  # columns from which on a longer answer is cut, so that its latency is seen
_FRONT = 2  # columns before the first cell: the sign of a fault and a blank
_HEADINGS = {TimeStyle.ABSOLUTE: "clock", TimeStyle.UTC: "UTC"}
_WHEN = slice(11, 24)  # the time of day of a date and time, to 0.1 ms


class FrameList(ScrollView, can_focus=True):
    """The rows of a view, of which the one at the position `cursor` is chosen.

    `held` is how many rows the recording had when the view was paused, None where it is not.
    Times count from `reference` (ns). `repeat` is the number typed before a key, None for none.
    `by_hand` is called when the choice was moved by hand.
    """

    COMPONENT_CLASSES: ClassVar[set[str]] = {"chosen"}
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("up", "move(-1)", show=False),
        Binding("down", "move(1)", show=False),
        Binding("pageup", "page(-1.0)", show=False),
        Binding("pagedown", "page(1.0)", show=False),
        Binding("ctrl+u", "page(-0.5)", show=False),
        Binding("ctrl+d", "page(0.5)", show=False),
        Binding("home", "app.go_to_number(1)", show=False),
        Binding("end", "app.go_to_number(0)", show=False),
    ]

    def __init__(
        self, recording: Recording, style: RowStyle, start_wall: int, by_hand: Callable[[], object]
    ) -> None:
        super().__init__(id="frames")
        self._by_hand = by_hand
        self.view = View(recording)
        self.cursor = 0
        self.held: int | None = None
        self.columns = style.columns
        self.reference = 0
        self.repeat: int | None = None
        self.lit = range(0)  # the bytes of the chosen row that stand out
        asked = style.time or TimeStyle.RELATIVE
        if asked is TimeStyle.DELTA:  # the row before is what another column counts from
            asked = TimeStyle.RELATIVE
        self.time_style = asked
        self._start_wall = start_wall
        self._recording = recording
        self._bytes_width = hex_width(recording.protocol)
        self._longest = 0  # bytes of the longest row that was drawn
        self._first = 0  # the first row of the view when it was last drawn
        self._lines: list[Text] = []

    @property
    def count(self) -> int:
        """How many rows are shown."""
        return self.view.count if self.held is None else self.view.position(self.held)

    @property
    def row(self) -> int | None:
        """The number of the chosen row in the recording; None without rows."""
        rows = self.view.rows(self.cursor, self.cursor + 1)
        return rows[0] if rows else None

    @property
    def record(self) -> Record | None:
        """The chosen row's record; None without rows."""
        row = self.row
        found = self._recording.records([row]) if row is not None else []
        return found[0] if found else None

    @property
    def room(self) -> int:
        """How many rows fit under the heading."""
        return max(1, self.size.height - 1)

    @property
    def top(self) -> int:
        """The position of the uppermost row on the screen."""
        return self._first + self.scroll_offset.y

    # Choosing.

    def choose(self, position: int) -> None:
        """Choose a row, the nearest one there is, and bring it onto the screen."""
        self.changed()
        self.cursor = min(max(position, self._first), max(self.count - 1, self._first))
        top, room = self.top, self.room
        if not top <= self.cursor < top + room:
            # One row further is one row; a leap puts the row into the middle.
            near = top - 1 <= self.cursor <= top + room
            above = (room - 1 if self.cursor > top else 0) if near else room // 2
            self.scroll_to(y=self.cursor - above - self._first, animate=False, force=True)

    def changed(self) -> None:
        """Draw all rows anew; the view may have grown or lost its oldest rows."""
        first, gone = self.view.first, self.view.first - self._first
        self._first = first
        self.virtual_size = Size(1, self.count - first + 1)
        self.cursor = min(max(self.cursor, first), max(self.count - 1, first))
        if gone:
            self.scroll_to(y=self.scroll_offset.y - gone, animate=False, force=True)
        self._lines.clear()
        self.refresh()

    def look_at(self, view: View) -> None:
        """Show another view, with the same row chosen if it has it."""
        row = self.row
        self.view = view
        self.choose(view.position(row or 0))

    def action_move(self, rows: int) -> None:
        """Move the choice by some rows."""
        self._choose_by_hand(self.cursor + rows * (self.repeat or 1))

    def action_page(self, pages: float) -> None:
        """Move the window and the choice by a screenful."""
        step = round(pages * self.room) * (self.repeat or 1)
        position = self.cursor + step
        self.scroll_to(y=self.scroll_offset.y + step, animate=False, force=True)
        self._choose_by_hand(position)

    def _choose_by_hand(self, position: int) -> None:
        self.choose(position)
        self._by_hand()

    def on_resize(self) -> None:
        """Keep the chosen row on the screen."""
        self.choose(self.cursor)

    def watch_scroll_y(self, old_value: float, new_value: float) -> None:
        """Keep the choice on the screen, also where the wheel or the bar moves it."""
        super().watch_scroll_y(old_value, new_value)
        self._lines.clear()
        inside = min(max(self.cursor, self.top), self.top + self.room - 1)
        if inside != self.cursor:
            self.cursor = inside
            self._by_hand()

    def on_click(self, event: events.Click) -> None:
        """Choose the row under the mouse."""
        place = event.get_content_offset(self)
        if place is not None and 0 < place.y <= self.count - self.top:
            self._choose_by_hand(self.top + place.y - 1)

    # Drawing.

    def render_line(self, y: int) -> Strip:
        """One line of the screen: the heading, then rows."""
        width, top = self.scrollable_content_region.width, self.top
        if not self._lines:
            self._lines = list(self.lines(top, min(top + self.room, self.count), width))
        line = self._lines[y] if y < len(self._lines) else Text()
        if y and top + y - 1 == self.cursor and line:
            line = self._chosen(line, width)
        line.truncate(width, overflow="crop", pad=True)
        return Strip(line.render(self.app.console, end="")).adjust_cell_length(width)

    def _chosen(self, line: Text, width: int) -> Text:
        """The chosen row, without colours, which would be a patchwork on its ground."""
        chosen = Text(line.plain)
        chosen.stylize(self.get_component_rich_style("chosen"))
        at = _FRONT
        for column, room in self._widths(width):
            for byte in self.lit if column.name == BYTES.name else ():
                chosen.stylize("bold underline", at + 3 * byte, at + 3 * byte + 2)
            at += room + 1
        return chosen

    def lines(self, first: int, stop: int, width: int) -> Iterator[Text]:
        """The heading, then the rows at the positions from `first` to before `stop`."""
        names = {TIME: _HEADINGS.get(self.time_style, "since row" if self.reference else "time")}
        cells = [
            _padded(names.get(column, column.heading), column, room)
            for column, room in self._widths(width)
        ]
        yield Text.assemble((" " * _FRONT + " ".join(cells), "dim"))
        before = first > self._first  # the row before the first is what its delta counts from
        rows = self.view.rows(first - before, stop)
        records = self._recording.records(rows)
        previous = records[0].t if records else 0
        framed = (one for one in records if isinstance(one, HostRecord | DeviceRecord))
        self._longest = max(self._longest, *(len(one.data) for one in framed), 0)
        for number, (row, record) in enumerate(zip(rows, records, strict=False)):
            if number or not before:
                yield self._line(row, record, previous, width)
            previous = record.t

    def _widths(self, width: int) -> list[tuple[Column, int]]:
        """The columns that fit, each with its width; the last one takes what is left."""
        usual = [column for column in OWN.values() if width >= _LEAST.get(column.name, 0)]
        left = width - _FRONT
        spare = left - sum(self._room(column) + 1 for column in usual) + _LENT
        fitting: list[tuple[Column, int]] = []
        for column in self.columns or usual:
            room = self._room(column)
            if column is BYTES and not self.columns:
                room = max(room, min(self._bytes_width, room + spare))
                room = max(room, min(3 * self._longest - 1, room + spare - _WORDY))
            if column is BYTES and width < _LEAST[NO.name]:
                room -= 3
            if fitting and left < min(room, 8):
                break
            fitting.append((column, min(room, left)))
            left -= min(room, left) + 1
        if fitting and left >= 0:
            fitting[-1] = fitting[-1][0], fitting[-1][1] + left + 1
        return fitting

    def _room(self, column: Column) -> int:
        if column is NO:
            return max(column.width, len(str(self._recording.rows)))
        if column is not TIME:
            return column.width
        return 10 if self.time_style is TimeStyle.RELATIVE else _WHEN.stop - _WHEN.start

    def _line(self, row: int, record: Record, previous: int, width: int) -> Text:
        look, line = look_of(record), json_line(record)
        text = Text(no_wrap=True)
        text.append(f"{look.sign} ", look.style)
        own = self._own(row, record, previous)
        for column, room in self._widths(width):
            cell = own.get(column.name, column.text(column.value(line)) if line else "")
            dim = column.name in own and column.name != BYTES.name
            if column is WHAT:
                text.append_text(self._what(record, look, room))
            else:
                text.append(_padded(cell, column, room), "dim" if dim else look.style)
            text.append(" ")
        text.right_crop()
        return text

    def _own(self, row: int, record: Record, previous: int) -> dict[str, str]:
        """The cells of the columns that are of this list alone, but what the row is."""
        if self.time_style is TimeStyle.RELATIVE:
            time = f"{(record.t - self.reference) / 1e9:.4f}"
        else:
            time = Times(self.time_style, self._start_wall).text(record.t)[_WHEN]
        arrow = {HostRecord: TO_DEVICE, DeviceRecord: TO_HOST}.get(type(record), NEITHER)
        data = record.hex if isinstance(record, HostRecord | DeviceRecord) else ""
        delta = (record.t - previous) / 1e6
        cells = (str(row + 1), time, f"{delta:.{int(abs(delta) < 1e6)}f}", arrow, data)
        return dict(zip(OWN, cells, strict=False))

    def _what(self, record: Record, look: Look, room: int) -> Text:
        """The row in words, the latency of an answer, and why it is odd."""
        words, reason = words_of(record)
        text = Text(words, look.style, end="")
        if isinstance(record, DeviceRecord) and record.latency is not None:
            if room >= _ROOMY:
                text.truncate(room - _LATENCY, overflow="ellipsis")
            text.pad_right(_LATE - text.cell_len)
            if text.cell_len + _LATENCY <= room:
                text = Text.assemble(text, (f"{record.latency / 1e6:8.2f} ms", "dim"))
        text = Text.assemble(text, (f"  {reason}" if reason else "", "dim"))
        if text.cell_len > room:
            text.truncate(max(0, room - 1), overflow="crop")
            text.append(CUT, "dim")
        text.pad_right(room - text.cell_len)
        return text


def _padded(text: str, column: Column, room: int) -> str:
    """The text of a cell in so many columns."""
    cut = text if len(text) <= room else text[: max(0, room - 1)] + CUT
    return cut.rjust(room) if column.right else cut.ljust(room)


def words_of(record: Record) -> tuple[str, str]:
    """What a row is, in words, and why it is odd, "" if it is not."""
    if isinstance(record, LineRecord):
        line = record.value
        words, why = f"{line.tap} line {line.event}".lstrip(), line.detail
    elif isinstance(record, FaultRecord):
        words, why = record.fault.kind, record.fault.reason
    else:
        words, why = record.words, record.reason
    if isinstance(record, HostRecord):
        told = record.judgement
        if told and told.truncated and told.id >= 0 and told.outcome is Outcome.TOO_FEW:
            why = record.note  # the words have how much came
    elif isinstance(record, DeviceRecord):
        answered = record.answered if record.agrees is False else None
        if answered and not (record.reply and record.reply.reason):
            words, why = f"{words}, expected {answered.response.name}", ""
    return printable(words), printable(why)
