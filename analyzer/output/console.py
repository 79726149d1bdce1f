"""Prints text, tables and JSON to standard output: styled on a terminal, plain lines in a pipe.

Each function imports rich itself: many commands print JSON or nothing but plain words.
"""

from __future__ import annotations

import codecs
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal

from bilprov.captures.text import escape_controls, escape_json

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.text import Text

# Wide enough that nothing wraps: in a pipe each fact stays on one line, so that grep finds it.
_PIPE_WIDTH = 100_000


def show(*parts: RenderableType) -> None:
    """Print the parts to the terminal's width; in a pipe unwrapped and without trailing blanks."""
    from rich.console import Console

    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = _PIPE_WIDTH
    with console.capture() as captured:
        for part in parts:
            console.print(part)
    sys.stdout.write("\n".join(line.rstrip() for line in captured.get().split("\n")))


NARROW = "bilprov-narrow"
"""The error handler of what is written in any encoding: signs that it lacks are ASCII ones."""
_ASCII = dict(
    zip(
        "→←◆…·▸▾█░┼●○▲▼▪■↻↺▁▂▃▄▅▆▇▏▎▍▌▋▊▉─━│┌┐└┘╭╮╰╯",
        "><*~-+-#.+*o^v.x)(..:-=+*#######-=|++++++++",
        strict=True,
    )
)


def _narrow(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    lacking = error.object[error.start : error.end]
    return "".join(_ASCII.get(sign, "?") for sign in lacking), error.end


codecs.register_error(NARROW, _narrow)


def show_json(value: Any) -> None:
    """Print one value as indented JSON."""
    import msgspec

    text = escape_json(msgspec.json.format(msgspec.json.encode(value), indent=2))
    sys.stdout.write(text.decode() + "\n")


def show_as(
    style: str, value: Callable[[], Any], parts: Callable[[], Iterable[RenderableType]]
) -> None:
    """Print `value` as JSON if the style is `json`, else the parts as text."""
    if style == "json":
        show_json(value())
    else:
        show(*parts())


def parts_of(value: Any, *names: str) -> dict[str, Any]:
    """The attributes of a value with these names, for JSON."""
    return {name: getattr(value, name) for name in names}


def heading(text: str, words: str = "", style: str = "not bold") -> Text:
    """A bold title for a table or a block, and the words behind it in their style."""
    return _safe(text, "bold").append(f"  {words}" if words else "", style)


def _safe(text: str, style: str = "") -> Text:
    """Text that may be foreign, made safe to show."""
    from rich.text import Text

    return Text(escape_controls(text), style=style)


def facts(rows: Iterable[tuple[str, str | Text]], indent: int = 2) -> RenderableType:
    """A grid of labels and their values; rows with an empty value are left out."""
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column()
    for label, said in rows:
        if said:
            grid.add_row(_safe(label), said if isinstance(said, Text) else _safe(said))
    return Padding(grid, (0, 0, 0, indent), expand=False)


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], right: str = "") -> RenderableType:
    """A table with a header line. The columns named in `right` are aligned to the right."""
    from rich.padding import Padding
    from rich.table import Table

    drawn = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    for name in columns:
        side: Literal["left", "right"] = "right" if name in right.split() else "left"
        drawn.add_column(_safe(name), justify=side, no_wrap=name != columns[-1])
    for row in rows:
        drawn.add_row(*(_safe(cell) for cell in row))
    return Padding(drawn, (0, 0, 0, 2), expand=False)
