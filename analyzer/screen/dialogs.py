"""The dialogs over the screen: the help, and the choice of columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import ClassVar, TypeVar

from rich.segment import Segment
from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import ModalScreen
from textual.strip import Strip
from textual.widgets import SelectionList, Static
from textual.widgets.selection_list import Selection

from bilprov.analyzer.screen.keys import BINDINGS, MOVES
from bilprov.analyzer.screen.signs import CHOSEN, LOOKS, UNCHOSEN
from bilprov.captures.text import escape_controls

Answer = TypeVar("Answer")


class Dialog(ModalScreen[Answer | None]):
    """A box over the screen; its result is None where it is left by Esc."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,q", "leave", show=False)]

    def action_leave(self) -> None:
        """Leave without an answer."""
        self.dismiss(None)


class Help(Dialog[str]):
    """The keys and what they do, and the signs."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("question_mark", "leave", show=False)]

    def compose(self) -> ComposeResult:
        """A table of keys, which scrolls on a small screen."""
        table = Table.grid(padding=(0, 2, 0, 0))
        table.add_column(no_wrap=True)
        table.add_column()
        keys = {key.key_display or "": key.tooltip for key in BINDINGS if key.tooltip}
        for key, says in (MOVES | keys).items():
            table.add_row(Text(key, "bold"), Text(says))
        table.add_row()
        for look, says in LOOKS.items():
            table.add_row(Text(look.sign, look.style), Text(says))
        with VerticalScroll(classes="box"):
            yield Static(table)


class ColumnChoice(Dialog[list[str]]):
    """Asks which columns are shown; the result is their names, None where nothing is changed."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("enter", "take", show=False, priority=True),
        Binding("c", "take", show=False),
    ]

    def __init__(self, columns: Mapping[str, str], chosen: Iterable[str]) -> None:
        super().__init__()
        room, shown = max(map(len, columns)) + 1, set(chosen)
        self._names = list(columns)
        self.listed = _Columns(
            *(
                Selection(Text(escape_controls(f"{name:<{room}}{says}")), name, name in shown)
                for name, says in columns.items()
            )
        )
        self.listed.border_title = "columns: Space chooses, Enter shows"

    def compose(self) -> ComposeResult:
        """The columns, each with what it says."""
        yield self.listed

    def action_take(self) -> None:
        """Give the names of the chosen columns, in the order of the list."""
        self.dismiss([name for name in self._names if name in self.listed.selected])


class _Columns(SelectionList[str]):
    def action_select(self) -> None:
        """Choose a column or leave it out at once; Textual's own does so after the next key."""
        if self.highlighted is not None:
            self.toggle(self.get_option_at_index(self.highlighted))

    def render_line(self, y: int) -> Strip:
        """A column with a sign that tells whether it is chosen; Textual's own do so by colour."""
        strip, index = super().render_line(y), self.scroll_offset.y + y
        if index >= self.option_count:
            return strip
        sign = CHOSEN if self.get_option_at_index(index).value in self.selected else UNCHOSEN
        _, _, _, space, *words = strip
        return Strip([Segment(sign, space.style), space, *words])
