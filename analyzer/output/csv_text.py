r"""Renders records as CSV (RFC 4180), which `--format csv` prints: a header row, then a row each.

The rows are those of the JSON lines, and so are the values: `t` and `latency` in seconds, true and
false, nothing for null. `fields.NAME` and `state.NAME` are columns of their own; `faults` are
joined by `; `.

Text is harmless where it is opened: a backslash becomes two, and a control, bidi or invisible
character an escape like `\x1b`; a text that a spreadsheet would take for a formula (it begins with
= + - or @, also of full width) gets a `'` before it, as does one that begins with `'`. Numbers stay
as they are.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from functools import lru_cache

from bilprov.analyzer.decode.json_lines import JsonLine, encode, json_line
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.output.row_columns import (
    TIME,
    Column,
    Times,
    Value,
    columns_of,
    converted,
    nanoseconds,
    own_columns,
)
from bilprov.captures.text import escape_controls
from bilprov.spec.protocol import Protocol

_FRONT = ("t", "direction", "kind", "hex", "name")
_BACK = ("sequence", "answers", "agrees", "faults")


def usual_columns(protocol: Protocol, *, time: bool = False) -> tuple[Column, ...]:
    """The columns of a table that is asked for none: all keys of the JSON lines.

    With `time` the column `time` comes first.
    """
    known = columns_of(protocol)
    fields = [name for name in known if name.startswith("fields.")]
    states = [name for name in known if name.startswith("state.")]
    own = [column.name for column in own_columns(protocol)]
    names = [*_FRONT, *own, *fields, "judgement", "reason", "latency", *states, *_BACK]
    return tuple(known[name] for name in (["time", *names] if time else names))


class CsvText:
    """Renders records as rows of CSV, each with its line end."""

    def __init__(self, columns: Sequence[Column], times: Times) -> None:
        self._columns = columns
        self._times = times
        self.header = ",".join(_text_cell(column.name) for column in columns) + "\r\n"

    def text(self, records: Iterable[Record]) -> str:
        """The rows of the records; a record without a JSON line gives none."""
        lines = [line for record in records if (line := json_line(record))]
        columns = [self._cells(column, lines) for column in self._columns]
        return "\r\n".join([*map(",".join, zip(*columns, strict=True)), ""])

    def _cells(self, column: Column, lines: Sequence[JsonLine]) -> Iterable[str]:
        if column is TIME:
            return [self._times.shown(nanoseconds(line.t)) for line in lines]
        return converted(map(column.value, lines), csv_cell)


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
_HARMLESS = re.compile(r"[\w .()]*", re.ASCII)


@lru_cache(maxsize=1 << 14)
def _text_cell(text: str) -> str:
    if _HARMLESS.fullmatch(text):  # most are
        return text
    written = io.StringIO()
    csv.writer(written, lineterminator="").writerow([neutral(text)])
    return written.getvalue()
