"""The dialogs over the screen: help, the choice of columns, names of files, the last question."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import ClassVar, TypeVar

from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical, VerticalScroll
from textual.events import Key
from textual.screen import ModalScreen
from textual.widgets import Input, OptionList, Static
from textual.widgets.option_list import Option

from bilprov.analyzer.screen.rows import Rows
from bilprov.analyzer.screen.signs import Signs
from bilprov.captures.text import escape_controls

Answer = TypeVar("Answer")


class Dialog(ModalScreen[Answer | None]):
    """A question over the screen; its result is None where it is left by Esc."""

    DEFAULT_CSS = """
    Dialog { align: center middle; }
    Dialog > Vertical, Dialog > VerticalScroll, Dialog > Rows {
        border: round ansi_blue; background: ansi_default;
        width: 64; max-width: 100%; height: auto; max-height: 100%; padding: 0 1;
    }
    Dialog.plain > Vertical, Dialog.plain > VerticalScroll, Dialog.plain > Rows {
        border: ascii ansi_blue;
    }
    Dialog Input, Dialog OptionList {
        border: none; height: auto; padding: 0; background: ansi_default;
    }
    Dialog Input { height: 1; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "leave", show=False)]

    def action_leave(self) -> None:
        """Leave without an answer."""
        self.dismiss(None)


class Help(Dialog[str]):
    """The keys and what they do."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("q,question_mark", "leave", show=False)]

    def __init__(self, keys: Mapping[str, str], about: str) -> None:
        super().__init__()
        self._keys = keys
        self._about = about

    def compose(self) -> ComposeResult:
        """A table of keys, which scrolls on a small screen."""
        table = Table.grid(padding=(0, 2, 0, 0))
        table.add_column(no_wrap=True, style="bold")
        table.add_column()
        for key, words in self._keys.items():
            table.add_row(key, Text(words))
        with VerticalScroll() as box:
            box.can_focus = True
            yield Static(table)
            yield Static(Text(f"\n{self._about}", "dim"))


class AskName(Dialog[str]):
    """Asks for the name of a file; `refusal` says why a name will not do, "" if it will."""

    def __init__(self, question: str, name: str, refusal: Callable[[str], str]) -> None:
        super().__init__()
        self._question = question
        self._name = name
        self._refusal = refusal

    def compose(self) -> ComposeResult:
        """The question, the line to type in, and what is wrong with it."""
        with Vertical():
            yield Static(Text(self._question))
            yield Input(self._name, compact=True, id="name")
            yield Static(Text("Enter saves, Esc goes back", "dim"), id="wrong")

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Give the name, if it will do."""
        name = event.value.strip()
        wrong = self._refusal(name) if name else "a name is needed"
        if wrong:
            self.query_one("#wrong", Static).update(Text(wrong, "red"))
        else:
            self.dismiss(name)


class Choice(Dialog[str]):
    """Asks to choose one of some answers, by arrows, mouse or the first letter."""

    def __init__(self, question: str, answers: Mapping[str, str]) -> None:
        super().__init__()
        self._question = question
        self._answers = answers

    def compose(self) -> ComposeResult:
        """The question and the answers."""
        with Vertical():
            yield Static(Text(self._question))
            options = (
                Option(Text.assemble((key, "bold"), f"  {words}"), id=key)
                for key, words in self._answers.items()
            )
            yield OptionList(*options)

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Give the answer."""
        self.dismiss(event.option_id)

    def on_key(self, event: Key) -> None:
        """Give the answer of a key, if it has one."""
        if event.key in self._answers:
            self.dismiss(event.key)


class ColumnChoice(Dialog[list[str]]):
    """Asks which columns are shown; the result is their names, None where nothing is changed."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("c", "take", show=False)]

    def __init__(self, columns: Mapping[str, str], chosen: Iterable[str], signs: Signs) -> None:
        super().__init__()
        self._listed = _Columns(columns, chosen, signs)

    def compose(self) -> ComposeResult:
        """The columns, each with what it says."""
        yield self._listed

    def on_rows_entered(self, event: Rows.Entered) -> None:
        """Show the columns that are chosen now."""
        event.stop()
        self.action_take()

    def action_take(self) -> None:
        """Give the names of the chosen columns, in the order of the list."""
        self.dismiss(self._listed.chosen)


class _Columns(Rows):
    """The columns that there are, each with a sign that tells whether it is chosen."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("space", "choose", show=False)]

    def __init__(self, columns: Mapping[str, str], chosen: Iterable[str], signs: Signs) -> None:
        super().__init__("columns: Space chooses, Enter shows", signs, "columns")
        self._columns = {name: name in set(chosen) for name in columns}
        room = max(map(len, columns)) + 1
        self._words = [escape_controls(f"{name:<{room}}{columns[name]}") for name in columns]

    @property
    def count(self) -> int:
        """How many columns there are."""
        return len(self._columns)

    @property
    def chosen(self) -> list[str]:
        """The names of those that are chosen."""
        return [name for name, chosen in self._columns.items() if chosen]

    def lines(self, first: int, stop: int, width: int) -> list[Text]:
        """The columns from `first` to before `stop`."""
        signs = [self.signs.lit if on else self.signs.unlit for on in self._columns.values()]
        return [Text(f"{signs[at]} {self._words[at]}") for at in range(first, stop)]

    def action_choose(self) -> None:
        """Choose the column, or no longer."""
        name = list(self._columns)[self.cursor]
        self._columns[name] = not self._columns[name]
        self.changed()

    def clicked(self, x: int) -> None:
        """A click chooses, as Space does."""
        self.action_choose()
