"""A list of lines of which one is chosen; only those on the screen are ever made."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import ClassVar

from rich.text import Text
from textual import events
from textual.binding import Binding, BindingType
from textual.geometry import Size
from textual.reactive import Reactive
from textual.scroll_view import ScrollView
from textual.strip import Strip


class Lines(ScrollView, can_focus=True):
    """Lines, of which the one at the position `cursor` is chosen; positions begin at `first`.

    `by_hand` is called when the choice was moved by hand. `repeat` is the number typed before a
    key, None for none.
    """

    HEADING = 0  # lines above those that are listed
    COMPONENT_CLASSES: ClassVar[set[str]] = {"chosen"}
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("up", "move(-1)", show=False),
        Binding("down", "move(1)", show=False),
        Binding("pageup", "page(-1.0)", show=False),
        Binding("pagedown", "page(1.0)", show=False),
        Binding("ctrl+u", "page(-0.5)", show=False),
        Binding("ctrl+d", "page(0.5)", show=False),
        Binding("home", "go_to_number(1)", show=False),
        Binding("end", "go_to_number(0)", show=False),
    ]
    virtual_size = Reactive(Size(0, 0))  # more lines need no new layout of the whole screen

    def __init__(self, name: str, by_hand: Callable[[], object]) -> None:
        super().__init__(id=name)
        self.cursor = 0
        self.first = 0
        self.repeat: int | None = None
        self._by_hand = by_hand
        self._lines: list[Text] = []

    @property
    def count(self) -> int:
        """The position after the last line."""
        raise NotImplementedError

    def lines(self, first: int, stop: int, width: int) -> Iterable[Text]:
        """The heading, if any, then the lines at the positions from `first` to before `stop`."""
        raise NotImplementedError

    def position(self, row: int) -> int:
        """The position of the line with this number, from 0, or of the next one."""
        return row

    @property
    def room(self) -> int:
        """How many lines fit under the heading."""
        return max(1, self.size.height - self.HEADING)

    @property
    def top(self) -> int:
        """The position of the uppermost line on the screen."""
        return self.first + self.scroll_offset.y

    def changed(self, first: int = 0) -> None:
        """Draw all lines again, which begin at the position `first` now."""
        gone, self.first = first - self.first, first
        self.cursor = min(max(self.cursor, first), max(self.count - 1, first))
        if gone:
            self.scroll_to(y=self.scroll_offset.y - gone, animate=False, force=True)
        self.virtual_size = Size(1, self.count - first + self.HEADING)
        self._lines.clear()
        self.refresh()

    def choose(self, position: int) -> None:
        """Choose a line, the nearest one there is, and bring it onto the screen."""
        self.cursor = min(max(position, self.first), max(self.count - 1, self.first))
        top, room = self.top, self.room
        if not top <= self.cursor < top + room:
            # One line further is one line; a leap puts the line into the middle.
            near = top - 1 <= self.cursor <= top + room
            above = (room - 1 if self.cursor > top else 0) if near else room // 2
            self.scroll_to(y=self.cursor - above - self.first, animate=False, force=True)
        self.refresh()

    def action_move(self, lines: int) -> None:
        """Move the choice by some lines."""
        self._choose_by_hand(self.cursor + lines * (self.repeat or 1))

    def action_page(self, pages: float) -> None:
        """Move the window and the choice by a screenful."""
        step = round(pages * self.room) * (self.repeat or 1)
        position = self.cursor + step
        self.scroll_to(y=self.scroll_offset.y + step, animate=False, force=True)
        self._choose_by_hand(position)

    def action_go_to_number(self, number: int) -> None:
        """Go to the line of this number, or of the one that was typed; 0 stands for the last."""
        number = self.repeat or number
        self._choose_by_hand(self.position(number - 1) if number else self.count - 1)

    def _choose_by_hand(self, position: int) -> None:
        self.choose(position)
        self._by_hand()

    def on_resize(self) -> None:
        """Keep the chosen line on the screen."""
        self._lines.clear()
        self.choose(self.cursor)

    def watch_virtual_size(self, before: Size, after: Size) -> None:
        """Draw the scroll bar again."""
        self._scroll_update(after)

    def watch_scroll_y(self, old_value: float, new_value: float) -> None:
        """Keep the choice on the screen, also where the wheel or the bar moves it."""
        super().watch_scroll_y(old_value, new_value)
        self._lines.clear()
        inside = min(max(self.cursor, self.top), self.top + self.room - 1)
        if inside != self.cursor:
            self.cursor = inside
            self._by_hand()

    def on_click(self, event: events.Click) -> None:
        """Choose the line under the mouse."""
        place = event.get_content_offset(self)
        position = self.top - self.HEADING + (place.y if place else 0)
        if place and self.top <= position < self.count:
            self._choose_by_hand(position)

    def render_line(self, y: int) -> Strip:
        """One line of the screen: the heading, then lines."""
        width, top = self.scrollable_content_region.width, self.top
        if not self._lines:
            self._lines = list(self.lines(top, min(top + self.room, self.count), width))
        line = self._lines[y] if y < len(self._lines) else Text()
        if top + y - self.HEADING == self.cursor and line:
            line = self.chosen(line, width)
        line.truncate(width, overflow="crop", pad=True)
        return Strip(line.render(self.app.console, end="")).adjust_cell_length(width)

    def chosen(self, line: Text, width: int) -> Text:
        """The chosen line, without colours, which would be a patchwork on its ground."""
        chosen = Text(line.plain)
        chosen.stylize(self.get_component_rich_style("chosen"))
        return chosen
