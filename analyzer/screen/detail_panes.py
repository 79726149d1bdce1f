"""The panes about the chosen row: the tree of its fields, and its bytes with the chosen bits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from rich.text import Text
from textual import events
from textual.message import Message
from textual.widget import Widget

from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.screen.details import Detail, covers, details, record_bytes
from bilprov.analyzer.screen.rows import Rows
from bilprov.analyzer.screen.signs import Signs
from bilprov.captures.text import escape_controls
from bilprov.spec.explain import BitGroup
from bilprov.spec.protocol import Protocol

_CELL = 9  # columns of a byte: its eight bits and a space
_INDENT = " " * 6  # of what goes on from the line above


class _Shown(NamedTuple):
    """One line of the tree: its detail, whether lines below it fold away, and what is shown."""

    detail: Detail
    folds: bool
    text: Text


class FieldTree(Rows):
    """The details of one record; a heading's lines fold away with Enter or a click on its sign."""

    def __init__(self, protocol: Protocol, signs: Signs) -> None:
        super().__init__("fields", signs, "tree")
        self._protocol = protocol
        self._all: tuple[Detail, ...] = ()
        self._shown: list[_Shown] = []
        self._folded: set[str] = set()

    @property
    def count(self) -> int:
        """How many lines are shown."""
        return len(self._shown)

    @property
    def group(self) -> BitGroup | None:
        """The bits of the chosen line; None if it is about none."""
        return self._shown[self.cursor].detail.group if self._shown else None

    def show(self, record: Record | None) -> None:
        """Show another record."""
        self._all = details(self._protocol, record) if record else ()
        self._unfold()

    def find(self, byte: int, bit: int) -> None:
        """Choose the line about a bit (counted from 0 at the right end) of a byte."""
        for at, shown in enumerate(self._shown):
            group = shown.detail.group
            if group and covers(group, byte, bit):
                self.choose(at)
                return

    def action_enter(self) -> None:
        """Fold or unfold the lines of the chosen heading."""
        if self._shown and self._shown[self.cursor].folds:
            self._folded ^= {self._shown[self.cursor].detail.label}
            self._unfold()

    def on_resize(self) -> None:
        """Wrap long lines anew."""
        self._unfold()

    def clicked(self, x: int) -> None:
        """Fold or unfold where the sign was clicked."""
        if x < 2:
            self.action_enter()

    def lines(self, first: int, stop: int, width: int) -> list[Text]:
        """The lines from `first` to before `stop`."""
        return [shown.text for shown in self._shown[first:stop]]

    def _line(self, detail: Detail, folds: bool) -> Text:
        sign = self.signs.folded if detail.label in self._folded else self.signs.unfolded
        bad = "yellow" if detail.bad else ""
        text = Text()
        if detail.depth:
            text.append(f"{'!' if detail.bad else ' '}  ", f"bold {bad}")
            text.append(f"{escape_controls(detail.label)}  ", bad or "cyan")
        else:
            text.append(f"{sign if folds else ' '} ")
            text.append(f"{escape_controls(detail.label)}  ", "bold")
        return text.append(escape_controls(detail.text), bad)

    def _unfold(self) -> None:
        below = [*(detail.depth for detail in self._all[1:]), 0]
        self._shown, hidden = [], False
        for detail, depth in zip(self._all, below, strict=False):
            if detail.depth == 0:
                hidden = detail.label in self._folded
            elif hidden:
                continue
            folds = detail.depth == 0 and depth > 0
            self._shown += self._wrapped(detail, folds)
        self.changed()

    def _wrapped(self, detail: Detail, folds: bool) -> Iterator[_Shown]:
        """The lines of a detail: more than one where it is longer than the pane is wide."""
        line = self._line(detail, folds)
        width = self.size.width - 1  # the scroll bar's
        if width <= 2 * len(_INDENT) or line.cell_len <= width:
            yield _Shown(detail, folds, line)
            return
        first, *more = line.wrap(self.app.console, width - len(_INDENT))
        yield _Shown(detail, folds, first)
        for part in more:
            yield _Shown(detail, False, Text(_INDENT) + part)


class HexPane(Widget):
    """The bytes of a record, each above its bits; those of the chosen field are marked."""

    DEFAULT_CSS = """
    HexPane { width: 1fr; }
    """

    class Clicked(Message):
        """A bit was clicked: counted from 0 at the right end of its byte."""

        def __init__(self, byte: int, bit: int) -> None:
            super().__init__()
            self.byte = byte
            self.bit = bit

    def __init__(self) -> None:
        super().__init__(id="hex")
        self.border_title = "bytes"
        self._data = b""
        self._group: BitGroup | None = None

    def show(self, record: Record | None, group: BitGroup | None) -> None:
        """Show the bytes of a record, with the bits of a field marked."""
        self._data = record_bytes(record) if record else b""
        self._group = group
        self.refresh()

    @property
    def _wide(self) -> int:
        """How many bytes fit beside each other."""
        return max(1, (self.size.width + 1) // _CELL)

    def render(self) -> Text:
        """The bytes and their bits, as many to a line as fit."""
        text = Text(no_wrap=True)
        for at in range(0, len(self._data), self._wide):
            part = range(at, min(at + self._wide, len(self._data)))
            for byte in part:
                chosen = any(self._chosen(byte, bit) for bit in range(8))
                text.append(f"{self._data[byte]:02x}", "reverse bold" if chosen else "bold")
                text.append(" " * (_CELL - 2))
            text.append("\n")
            for byte in part:
                for bit in reversed(range(8)):
                    style = "reverse" if self._chosen(byte, bit) else "dim"
                    text.append(str(self._data[byte] >> bit & 1), style)
                text.append(" ")
            text.append("\n")
        return text

    def on_click(self, event: events.Click) -> None:
        """Tell which bit was clicked."""
        place = event.get_content_offset(self)
        if place is None:
            return
        byte = place.y // 2 * self._wide + place.x // _CELL
        if byte < len(self._data) and place.x // _CELL < self._wide:
            self.post_message(self.Clicked(byte, max(0, 7 - place.x % _CELL)))

    def _chosen(self, byte: int, bit: int) -> bool:
        return self._group is not None and covers(self._group, byte, bit)
