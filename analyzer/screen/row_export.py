"""Writes the rows of a view into a new file, as CSV or as JSON lines."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, cast

from bilprov.analyzer.files import whole_file, why_not_writable
from bilprov.analyzer.output.outputs import opened_output
from bilprov.analyzer.output.row_columns import RowStyle
from bilprov.analyzer.screen.recording import Recording, View
from bilprov.captures.text import printable, quantity

_TOGETHER = 4096  # rows
_FORMATS = ("csv", "jsonl")


def rows_file(name: str) -> str:
    """The name of a new file for rows. Raises ValueError if they cannot be written there."""
    if Path(name).suffix[1:] not in _FORMATS:
        raise ValueError("the name ends in .csv or .jsonl, which sets the format")
    return new_file(name)


def new_file(name: str) -> str:
    """The name of a new file. Raises ValueError if none can have it."""
    path = Path(name)
    try:
        there = path.exists() or path.is_symlink()
        why = why_not_writable(path)
    except (OSError, ValueError) as error:
        raise ValueError(f"no file can have this name: {printable(error)}") from error
    if there:
        raise ValueError(f"{printable(name)} exists and is never overwritten: choose another name")
    if why:
        raise ValueError(why)
    return name


def export(
    recording: Recording,
    view: View,
    name: str,
    rows: RowStyle,
    start_wall: int,
    goes_on: Callable[[float], bool] = lambda share: True,
) -> str:
    """Write the rows that a view has now, and return in a sentence how it ended.

    `goes_on` is asked with the share that is written; where it denies, no file is left.
    """
    first, count, written = view.first, view.count, 0
    style = cast(Literal["csv", "jsonl"], Path(name).suffix[1:])

    def write(text: str) -> None:
        nonlocal written
        file.write(text.encode("utf-8", "backslashreplace"))
        written += text.count("\n")  # events of the line are rows only on the screen

    try:
        with whole_file(Path(name), replace=False) as file:
            output = opened_output(style, recording.protocol, rows, start_wall, write)
            written = 0
            for at in range(first, count, _TOGETHER):
                if not goes_on((at - first) / (count - first)):
                    raise InterruptedError(0, "stopped")
                output.records(recording.records(view.rows(at, min(at + _TOGETHER, count))))
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        return f"{printable(name)} cannot be written ({printable(why)})"
    return f"{quantity(written, 'row')} written to {printable(name)}"
