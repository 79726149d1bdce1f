"""The keys and the signs of the screen, and the help about them.

What matters in a row is one of four looks, the same in every pane: a sign and a colour. Narrow
encodings have other signs (`output.console`).
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple

from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Static

from bilprov.analyzer.decode.records import (
    DeviceRecord,
    FaultRecord,
    HostRecord,
    Record,
    serious_faults,
)
from bilprov.spec.fields import Outcome


class Look(NamedTuple):
    """How something that matters is shown: its sign, which tells it without colours too."""

    sign: str
    style: str


ORDINARY = Look(" ", "")
REFUSAL = Look("-", "yellow")
HOST_FAULT = Look("!", "bold yellow")
DEVICE_FAULT = Look("x", "bold red")
LINE_FAULT = Look("~", "cyan")
LOOKS = {
    HOST_FAULT: "fault of the host",
    DEVICE_FAULT: "fault of the device",
    LINE_FAULT: "fault of the line",
    REFUSAL: "an answer that refuses a faulty frame, as it should",
}
"""What the looks mean, for the help."""


def look_of(record: Record) -> Look:
    """The look of a row."""
    if serious_faults(record):
        if isinstance(record, HostRecord):
            return HOST_FAULT
        return DEVICE_FAULT if isinstance(record, DeviceRecord | FaultRecord) else LINE_FAULT
    answer = record.answer if isinstance(record, DeviceRecord) else None
    return REFUSAL if answer and answer.outcome is not Outcome.VALID else ORDINARY


TO_DEVICE, TO_HOST, NEITHER = "→", "←", " "
CUT, RECORDS = "…", "●"
FOLDED, UNFOLDED = "▸ ", "▾ "


def _key(keys: str, action: str, shown: str, says: str, word: str = "") -> Binding:
    """A key; it stands in the footer where it has a `word`."""
    return Binding(keys, action, word, show=bool(word), key_display=shown, tooltip=says)


BINDINGS = [
    _key("slash", "filter", "/", "filter the rows; an empty filter shows all", "filter"),
    _key("n", "fault(1)", "n N", "the next, the previous fault", "fault"),
    _key("N", "fault(-1)", "", ""),
    _key("e", "only_faults", "e", "show only the rows with a fault, or all again", "only faults"),
    _key("space", "pause", "Space", "hold a live view still; play a capture", "pause/play"),
    _key("f", "follow", "f", "follow what comes", "follow"),
    _key("t", "times", "t", "times since the start, of the clock here, in UTC", "time"),
    _key("r", "reference", "r", "count times from this row; again: from the start"),
    _key("colon", "go", ":", "go to a row (120), or to a time (12.5s, 14:03:20)", "go to"),
    _key("x", "export", "x", "write the rows that are shown, as CSV or JSON lines", "export"),
    _key("y", "copy", "y", "copy the frame as a `bilprov send` line", "copy"),
    _key("question_mark,f1", "push_screen('help')", "?", "this help", "help"),
    _key("q", "leave", "q", "leave", "quit"),
    Binding("ctrl+c,ctrl+q", "leave", show=False, priority=True),
    Binding("ctrl+z", "suspend_process", show=False, priority=True),
    Binding("escape", "go_back", show=False),
    Binding("enter,right", "fields", show=False),
]
"""Keys that no pane takes for itself; the actions are those of the `Browser`."""

MOVES = {
    "j k, arrows": "the row after, the row before; 5j: five rows on",
    "^F ^B, PgDn PgUp": "a screenful on, back; ^D ^U: half of one",
    "g G, Home End": "the first, the last row; 120G: row 120",
    "Enter, Tab": "go to the fields of a frame; the next pane",
    "h l": "in the fields: fold, unfold",
    "^Z": "suspend; fg goes on",
    "^C": "leave; the second time without saving",
    "Esc": "go back; stop a filter or an export that takes long",
}
"""Keys of the panes, for the help."""

ALIASES = {
    "j": "down",
    "k": "up",
    "h": "left",
    "l": "right",
    "g": "home",
    "G": "end",
    "ctrl+f": "pagedown",
    "ctrl+b": "pageup",
    "ctrl+d": "pagedown",
    "ctrl+u": "pageup",
}
"""Keys of less and vim, and those of Textual's widgets that they stand for."""


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
