r"""Renders records as CSV (RFC 4180), which `--format csv` prints: a header row, then a row each.

The rows are those of the JSON lines, and so are the values: `t` and `latency` in seconds, true and
false, nothing for null. `fields.NAME` and `state.NAME` are columns of their own; `faults` are
joined by `; `.

Text is harmless where it is opened: a backslash becomes two, and a control, bidi or invisible
character an escape like `\x1b`; a text that a spreadsheet would take for a formula (it begins with
= + - or @, also of full width) gets a `'` before it, as does one that begins with `'`. `plain`
turns a cell's text back. Numbers stay as they are.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

from bilprov.analyzer.decode.json_lines import JsonLine, encode, json_line
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.output.row_columns import (
    TIME,
    Column,
    Times,
    Value,
    columns_of,
    nanoseconds,
)
from bilprov.captures.schemas import State
from bilprov.captures.text import escape_controls
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.columns.stretch import Stretch
    from bilprov.analyzer.output.stretch_rows import StretchRows

_FRONT = ("t", "direction", "kind", "hex", "name")
_BACK = ("sequence", "answers", "agrees", "faults")


def usual_columns(protocol: Protocol, *, time: bool = False) -> tuple[Column, ...]:
    """The columns of a table that is asked for none: all keys of the JSON lines.

    With `time` the column `time` comes first.
    """
    known = columns_of(protocol)
    fields = [name for name in known if name.startswith("fields.")]
    states = [f"state.{name}" for name in State.__struct_fields__]
    names = [*_FRONT, *fields, "judgement", "reason", "latency", *states, *_BACK]
    return tuple(known[name] for name in (["time", *names] if time else names))


class CsvText:
    """Renders records and stretches as rows of CSV, each with its line end."""

    def __init__(self, columns: Sequence[Column], times: Times) -> None:
        self._columns = columns
        self._times = times
        self._cells = [self._cell(column) for column in columns]
        self.header = ",".join(_text_cell(column.name) for column in columns) + "\r\n"

    def records(self, records: Iterable[Record]) -> str:
        """The rows of the records; a record without a JSON line gives none."""
        made = self._cells
        return "".join(
            ",".join([cell(line) for cell in made]) + "\r\n"
            for record in records
            if (line := json_line(record)) is not None
        )

    def stretch(self, stretch: Stretch) -> str:
        """The rows of all records of a stretch."""
        from bilprov.analyzer.output.stretch_rows import StretchRows

        rows = StretchRows(stretch)
        columns = [self._texts(rows, column) for column in self._columns]
        lines = list(map(",".join, zip(*columns, strict=True)))
        return "\r\n".join([*lines, ""])

    def _texts(self, rows: StretchRows, column: Column) -> Iterable[str]:
        if column is TIME:
            return map(self._times.shown, rows.t.tolist())
        values, place = rows.cells(column)
        texts = list(map(csv_cell, values))
        return map(texts.__getitem__, place.tolist())

    def _cell(self, column: Column) -> Callable[[JsonLine], str]:
        if column is TIME:
            return lambda line: self._times.shown(nanoseconds(line.t))
        value = column.value
        return lambda line: csv_cell(value(line))


def csv_cell(value: Value) -> str:
    """The text of a value in CSV, quoted where it must be."""
    if type(value) is str:
        return _text_cell(value)
    if type(value) is int:
        return str(value)
    return "" if value is None else encode(value).decode()


def neutral(text: str) -> str:
    """The text as the module's docstring says: no formula, and without control characters."""
    shown = escape_controls(text.replace("\\", "\\\\"))
    return f"'{shown}" if shown.startswith(_FORMULA) else shown


_FORMULA = ("=", "+", "-", "@", "＝", "＋", "－", "＠", "'")
_ESCAPED = re.compile(r"\\(\\|[tnr]|x[0-9a-f]{2}|u[0-9a-f]{4}|U[0-9a-f]{8})")
_NAMED = {"\\": "\\", "t": "\t", "n": "\n", "r": "\r"}
_HARMLESS = re.compile(r"[\w .()]*", re.ASCII)


def plain(cell: str) -> str:
    """The text that `neutral` was given."""
    return _ESCAPED.sub(
        lambda found: _NAMED.get(found[1]) or chr(int(found[1][1:], 16)), cell.removeprefix("'")
    )


@lru_cache(maxsize=1 << 14)
def _text_cell(text: str) -> str:
    if _HARMLESS.fullmatch(text):  # most are
        return text
    written = io.StringIO()
    csv.writer(written, lineterminator="").writerow([neutral(text)])
    return written.getvalue()
