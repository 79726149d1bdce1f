"""A pane of lines of which one is chosen; only the lines on the screen are ever made.

Keys and wheel move the choice and the window in whole lines, however many there are, without
Textual's layout: a recording grows ten times a second.
"""

from __future__ import annotations

from typing import ClassVar

from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual import events
from textual.binding import Binding, BindingType
from textual.geometry import Size
from textual.message import Message
from textual.strip import Strip
from textual.widget import Widget

from bilprov.analyzer.screen.signs import Signs

WHEEL = 3  # lines
_DIM = Style(dim=True)
_CHOSEN, _CHOSEN_ELSEWHERE = Style(reverse=True), Style(bold=True, underline=True)


class Rows(Widget, can_focus=True):
    """Lines 0 to `count`, of which `cursor` is chosen; `top` is the first one on the screen.

    A subclass says how many there are (`count`) and what they look like (`lines`), and may have a
    `heading` above them.
    """

    DEFAULT_CSS = """
    Rows { height: 1fr; width: 1fr; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("up,k", "move(-1)", show=False),
        Binding("down,j", "move(1)", show=False),
        Binding("pageup,ctrl+b", "page(-1)", show=False),
        Binding("pagedown,ctrl+f", "page(1)", show=False),
        Binding("home,g", "first", show=False),
        Binding("end,G", "last", show=False),
        Binding("enter", "enter", show=False),
    ]

    class Chosen(Message):
        """The choice was moved by hand."""

        def __init__(self, rows: Rows) -> None:
            super().__init__()
            self.rows = rows

    class Entered(Chosen):
        """Enter was pressed on the chosen line."""

    def __init__(self, title: str, signs: Signs, id: str) -> None:
        super().__init__(id=id)
        self.signs = signs
        self.border_title = title
        self.cursor = 0
        self.top = 0
        self._lines: dict[int, Text] = {}
        self._dragged = False

    @property
    def count(self) -> int:
        """How many lines there are."""
        return 0

    @property
    def start(self) -> int:
        """The first line that is there."""
        return 0

    def heading(self, width: int) -> Text | None:
        """A line that stays above the others; None for none."""
        return None

    def lines(self, first: int, stop: int, width: int) -> list[Text]:
        """The lines from `first` to before `stop`, which are there."""
        return []

    @property
    def room(self) -> int:
        """How many lines fit under the heading."""
        return max(0, self.size.height - (self.heading(self.size.width) is not None))

    def choose(self, line: int) -> None:
        """Choose a line, the nearest one there is, and bring it onto the screen."""
        self.cursor = min(max(line, self.start), max(self.count - 1, self.start))
        room = max(1, self.room)
        if self.cursor < self.top or self.cursor >= self.top + room:
            # One line further is one line; a leap puts the line into the middle.
            near = self.top - 1 <= self.cursor <= self.top + room
            ahead = room - 1 if self.cursor >= self.top else 0
            self.top = self.cursor - (ahead if near else room // 2)
        self.changed()

    def changed(self) -> None:
        """Draw all lines anew."""
        self.top = max(self.start, min(self.top, self.count - self.room))
        self.cursor = min(max(self.cursor, self.start), max(self.count - 1, self.start))
        self._lines.clear()
        self.refresh()

    def action_move(self, lines: int) -> None:
        """Move the choice by some lines."""
        self._choose_by_hand(self.cursor + lines)

    def action_page(self, pages: int) -> None:
        """Move the window and the choice by a screenful."""
        step = pages * max(1, self.room - 1)
        self.top = max(self.start, min(self.top + step, self.count - self.room))
        self._choose_by_hand(self.cursor + step)

    def action_first(self) -> None:
        """Choose the first line."""
        self._choose_by_hand(self.start)

    def action_last(self) -> None:
        """Choose the last line."""
        self._choose_by_hand(self.count - 1)

    def action_enter(self) -> None:
        """Tell that Enter was pressed."""
        if self.count > self.start:
            self.post_message(self.Entered(self))

    def _choose_by_hand(self, line: int) -> None:
        self.choose(line)
        self.post_message(self.Chosen(self))

    def on_resize(self) -> None:
        """Keep the chosen line on the screen."""
        self.choose(self.cursor)

    def on_mouse_scroll_up(self, event: events.MouseScrollUp) -> None:
        """Show earlier lines."""
        event.stop()
        self._scroll(-WHEEL)

    def on_mouse_scroll_down(self, event: events.MouseScrollDown) -> None:
        """Show later lines."""
        event.stop()
        self._scroll(WHEEL)

    def _scroll(self, lines: int) -> None:
        top = max(self.start, min(self.top + lines, self.count - self.room))
        if top == self.top:
            return
        self.top = top
        self._choose_by_hand(min(max(self.cursor, top), top + max(1, self.room) - 1))

    def on_mouse_down(self, event: events.MouseDown) -> None:
        """Choose the line under the mouse, or take hold of the scroll bar."""
        place = event.get_content_offset(self)
        if place is None:
            return
        at = place.y - (self.size.height - self.room)
        if place.x >= self.size.width - 1 and self._scrolls:
            self._dragged = True
            self.capture_mouse()
            self._drag(at)
        elif 0 <= at < self.room and self.top + at < self.count:
            self._choose_by_hand(self.top + at)
            self.clicked(place.x)

    def on_mouse_move(self, event: events.MouseMove) -> None:
        """Move along the scroll bar."""
        if self._dragged:
            place = event.get_content_offset_capture(self)
            self._drag(place.y - (self.size.height - self.room))

    def on_mouse_up(self) -> None:
        """Let the scroll bar go."""
        if self._dragged:
            self._dragged = False
            self.release_mouse()

    def clicked(self, x: int) -> None:
        """The chosen line was clicked, in column `x`."""

    def _drag(self, at: int) -> None:
        share = min(max(at / max(1, self.room - 1), 0.0), 1.0)
        self.top = self.start + round(share * max(0, self.count - self.start - self.room))
        self._choose_by_hand(self.top + round(share * max(0, self.room - 1)))

    @property
    def _scrolls(self) -> bool:
        return self.count - self.start > self.room > 1

    def _thumb(self) -> range:
        """The screen lines, under the heading, that the scroll bar's thumb covers."""
        room, many = self.room, self.count - self.start
        size = max(1, room * room // many)
        at = round((room - size) * (self.top - self.start) / max(1, many - room))
        return range(at, at + size)

    def render_line(self, y: int) -> Strip:
        """One line of the screen."""
        width = self.size.width - self._scrolls
        heading = self.heading(width)
        at = y - (heading is not None)
        if at < 0:
            assert heading is not None
            return self._strip(heading, width, chosen=False)
        line = self.top + at
        if line >= self.count or line < self.start:
            return Strip.blank(self.size.width)
        if line not in self._lines:
            stop = min(self.top + self.room, self.count)
            shown = self.lines(self.top, stop, width)
            self._lines = dict(enumerate(shown, self.top))
        strip = self._strip(self._lines.get(line, Text()), width, chosen=line == self.cursor)
        if not self._scrolls:
            return strip
        bar = Segment(self.signs.scroll, _DIM) if at in self._thumb() else Segment(" ")
        return Strip.join([strip, Strip([bar])])

    def _strip(self, text: Text, width: int, *, chosen: bool) -> Strip:
        text = text.copy()
        text.truncate(width, overflow="crop", pad=True)
        if not chosen:
            return Strip(text.render(self.app.console, end="")).adjust_cell_length(width)
        # Without colours, which would be a patchwork.
        style = _CHOSEN if self.has_focus else _CHOSEN_ELSEWHERE
        return Strip([Segment(text.plain, style)]).adjust_cell_length(width)

    def get_content_height(self, container: Size, viewport: Size, width: int) -> int:
        """As high as there are lines."""
        return self.count - self.start
