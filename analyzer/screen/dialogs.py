"""The help over the screen."""

from __future__ import annotations

from typing import ClassVar

from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Static

from bilprov.analyzer.screen.keys import BINDINGS, MOVES
from bilprov.analyzer.screen.signs import LOOKS


class Help(ModalScreen[None]):
    """The keys and what they do, and the signs."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,q,question_mark", "dismiss", show=False)
    ]

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
