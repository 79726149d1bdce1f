"""The keys of the whole screen: the action that each starts, and what the help says of them."""

from __future__ import annotations

from textual.binding import Binding

BINDINGS = [
    Binding("slash", "filter", show=False),
    Binding("n", "fault(1)", show=False),
    Binding("N", "fault(-1)", show=False),
    Binding("space", "pause", show=False),
    Binding("f", "follow", show=False),
    Binding("m", "mark", show=False),
    Binding("apostrophe", "next_mark", show=False),
    Binding("t", "times", show=False),
    Binding("c", "columns", show=False),
    Binding("x", "export", show=False),
    Binding("question_mark,f1", "keys", show=False),
    Binding("q", "leave", show=False),
    Binding("ctrl+c,ctrl+q", "end", show=False, priority=True),
    Binding("escape", "go_back", show=False),
]
"""Keys that no pane takes for itself; the actions are those of the `Browser`."""

KEYS = {
    "arrows, k j": "the row before or after",
    "PgUp PgDn": "a screenful",
    "Home End, g G": "the first, the last row",
    "/": "filter; Tab completes, Enter filters; an empty one shows all rows",
    "n N": "the next, the previous fault",
    "Tab": "the next pane",
    "Enter": "go to a frame's fields; fold a tree; go to a fault",
    "Space": "pause or resume a live view; play a capture from the chosen row, or stop",
    "f": "follow new rows",
    "m '": "mark a row; go to the next mark",
    "t": "how times are shown: since the start, since the row before, clock, UTC",
    "c": "which columns are shown",
    "x": "export what the filter shows, as CSV or JSON lines",
    "Esc": "go back; stop a filter or an export that takes long",
    "?": "this help",
    "q": "quit",
}
ABOUT = (
    "A row begins with ! where something is wrong with it, and with a mark where you set one. "
    "The mouse chooses rows, fields and bits, and the wheel moves a pane."
)
