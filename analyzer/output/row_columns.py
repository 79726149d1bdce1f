r"""The columns of a row of traffic, and the ways to write its time; lines, CSV and lists use them.

A row is a JSON line (`json_lines`), and most columns are one of its keys. `columns_of` has those of
a grammar: the ones of COLUMNS, and one for each field of its instructions, under the field's name
and as `fields.NAME`; where a field is called like a column, only the latter reaches it.

CSV is RFC 4180: a header row, then a row each. Its values are those of the JSON lines: `t` and
`latency` in seconds, true and false, nothing for null. `fields.NAME` and `state.NAME` are columns
of their own; `faults` are joined by `; `.

Text is harmless where it is opened: a backslash becomes two, and a control, bidi or invisible
character an escape like `\x1b`; a text that a spreadsheet would take for a formula (it begins with
= + - or @, also of full width) gets a `'` before it, as does one that begins with `'`. Numbers stay
as they are.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from functools import lru_cache
from itertools import chain
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias, TypeVar

from msgspec import UNSET, UnsetType

from bilprov.analyzer.decode.json_lines import JsonLine, encode, json_line
from bilprov.analyzer.decode.records import Record, severity_of
from bilprov.analyzer.output.text_lines import painted
from bilprov.captures.text import escape_controls, near, printable
from bilprov.spec.data import DataSpec
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

Value: TypeAlias = str | int | float | bool | None
"""What a column has in a row; None where the row lacks it."""

Result = TypeVar("Result")
_Text: TypeAlias = Callable[[Value], str]

SECOND = 1_000_000_000  # ns


class TimeStyle(StrEnum):
    """How the column `time` is written.

    `relative` is seconds since the recording's start, `delta` seconds since the row shown before;
    `absolute` is date and time of day where the reader is, `utc` the same in UTC.
    """

    RELATIVE = "relative"
    DELTA = "delta"
    ABSOLUTE = "absolute"
    UTC = "utc"


_TIME_WIDTHS = {TimeStyle.ABSOLUTE: 26, TimeStyle.UTC: 27}


@dataclass(slots=True)
class Times:
    """Writes the times of rows in one style, to the microsecond, in the order they are shown.

    `start_wall` is the wall clock (ns since 1970) at the recording's start.
    """

    style: TimeStyle = TimeStyle.RELATIVE
    start_wall: int = 0
    _previous: int | None = None

    @property
    def width(self) -> int:
        """How many characters a time takes; only seconds over 99,999 take more."""
        return _TIME_WIDTHS.get(self.style, 12)

    def shown(self, t: int) -> str:
        """The text of the next row's time `t` (ns since the start)."""
        previous, self._previous = self._previous, t
        return self.text(t, previous)

    def padded(self, t: int) -> str:
        """The same as wide as all others, for a list."""
        return f"{self.shown(t):>{self.width}}"

    def text(self, t: int, previous: int | None = None) -> str:
        """The text of a time (ns since the start); `previous` is that of the row before, if any."""
        if self.style is TimeStyle.RELATIVE:
            return f"{t / 1e9:.6f}"
        if self.style is TimeStyle.DELTA:
            return f"{(0 if previous is None else t - previous) / 1e9:.6f}"
        second, rest = divmod(self.start_wall + t, SECOND)
        clock = _clock(second, self.style is TimeStyle.UTC)
        return f"{clock}.{rest // 1000:06d}{'Z' if self.style is TimeStyle.UTC else ''}"


@lru_cache(maxsize=64)
def _clock(second: int, utc: bool) -> str:
    """Date and time of a second since 1970, as ISO 8601 has it (here with a blank between)."""
    if utc:
        return datetime.fromtimestamp(second, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return datetime.fromtimestamp(second).strftime("%Y-%m-%d %H:%M:%S")  # noqa: DTZ006


class Column(NamedTuple):
    """One column: its name, and how a list shows it.

    `value` gets it from a row and `text` makes it readable for people. `width` is how many
    characters usual values take; numbers stand to the `right`.
    """

    name: str
    heading: str
    width: int
    value: Callable[[JsonLine], Value]
    text: _Text = lambda value: _plain(value)
    right: bool = False


def converted(values: Iterable[Value], convert: Callable[[Any], Result]) -> list[Result]:
    """What `convert` makes of the values of a column; it is called once for each distinct one."""
    listed = list(values)
    known = {value: convert(value) for value in set(listed)}
    return [known[value] for value in listed]


def nanoseconds(seconds: float) -> int:
    """A row's time or latency as the whole number that it was made from."""
    return round(seconds * 1e9)


def _plain(value: Value) -> str:
    if value is None:
        return ""
    return str(value).lower() if isinstance(value, bool) else printable(value)


def _seconds(value: Value) -> str:
    return "" if value is None else f"{value:.6f}"


def _milliseconds(value: Value) -> str:
    return f"{value * 1e3:.3f} ms" if isinstance(value, float) else ""


def _latency_ns(line: JsonLine) -> int | None:
    return None if line.latency is None else nanoseconds(line.latency)


def _frame(line: JsonLine) -> bytes | None:
    """The bytes of a row with an instruction, whole or truncated."""
    return bytes.fromhex(line.hex) if line.kind in ("instruction", "truncated") else None


def _about_frames(protocol: Protocol) -> tuple[Column, Column, Column]:
    """The columns of what is in a frame: its ID, the number of its data bytes, and these."""
    layout = protocol.layout

    def data_of(line: JsonLine) -> bytes | None:
        frame = _frame(line)
        if frame is None:
            return None
        return frame[layout.head :] if line.kind == "truncated" else layout.data_of(frame)

    def identity(line: JsonLine) -> Value:
        frame = _frame(line)
        return None if frame is None or len(frame) < layout.head else layout.value("id", frame)

    def length(line: JsonLine) -> Value:
        data, frame = data_of(line), _frame(line)
        if data is None or frame is None:
            return None
        return layout.value("length", frame) if protocol.plain else len(data)

    def data(line: JsonLine) -> Value:
        found = data_of(line)
        return None if found is None else found.hex(" ")

    return (
        Column("id", "id", 3, identity, right=True),
        Column("len", "len", 3, length, right=True),
        Column("data", "data", 8, data),
    )


def _response(line: JsonLine) -> str | None:
    return line.name if line.kind == "response" else None


def _described(line: JsonLine) -> str | None:
    return " ".join(f"{name}={value}" for name, value in line.fields.items()) or None


def _time(line: JsonLine) -> Value:
    return f"{line.t:.6f}"  # `cells` writes it in the chosen style


def _key(
    name: str, heading: str, width: int, text: _Text = _plain, *, right: bool = False
) -> Column:
    """The column of a key of the JSON lines, empty where a line lacks it."""

    def value(line: JsonLine) -> Value:
        found: Value | UnsetType = key(line)
        return None if found is UNSET else found

    key = attrgetter(name)
    return Column(name, heading, width, value, text, right)


COLUMNS: Mapping[str, Column] = {
    column.name: column
    for column in (
        Column("time", "time", 12, _time, right=True),
        _key("t", "t", 12, _seconds, right=True),
        Column("t_ns", "t ns", 15, lambda line: nanoseconds(line.t), right=True),
        _key("direction", "from", 6),
        _key("kind", "kind", 11),
        _key("hex", "hex", 11),
        Column("bytes", "bytes", 11, attrgetter("hex")),  # in Parquet the bytes themselves
        _key("name", "name", 13),
        Column("fields", "fields", 14, _described),
        _key("judgement", "judgement", 13),
        Column("response", "response", 13, _response),
        _key("latency", "latency", 12, _milliseconds, right=True),
        Column("latency_ns", "latency ns", 10, _latency_ns, right=True),
        Column("state", "state", 26, attrgetter("state.described")),
        _key("sequence", "number", 8, right=True),
        _key("answers", "answers", 8, right=True),
        _key("agrees", "agrees", 6),
        Column("faults", "faults", 20, lambda line: "; ".join(line.faults)),
        _key("reason", "reason", 40),
    )
}
"""The columns of every grammar but `id`, `len`, `data`, the fields and the variables of the state.
"""

TIME = COLUMNS["time"]


def columns_of(protocol: Protocol) -> dict[str, Column]:
    """All columns of a grammar by the names under which they can be asked for."""
    identity, length, data = _about_frames(protocol)
    fields = _fields(protocol)
    columns = list(COLUMNS.values())
    columns.insert(columns.index(COLUMNS["bytes"]) + 1, data)
    at = columns.index(COLUMNS["state"]) + 1
    for name, spec in protocol.variables.items():
        width = max(map(len, spec.words), default=len(name))
        columns.insert(at, _key(f"state.{name}", name, width, right=not spec.words))
        at += 1
    if protocol.at_rest:
        columns.insert(at, _key("state.moving", "moving", len("moving")))
    columns = [*fields, *columns, identity, length, *own_columns(protocol)]
    columns += [column._replace(name=f"fields.{column.name}") for column in fields]
    return {column.name: column for column in columns}


def own_columns(protocol: Protocol) -> Iterator[Column]:
    """The columns of keys that the lines of some grammars have."""
    if not protocol.plain:
        yield _key("outcome", "outcome", 12)
    if protocol.layout.part("address"):
        yield _key("address", "to", 4, right=True)
    if not protocol.plain:
        yield _key("uncertain", "uncertain", 9)


def bytes_fields(protocol: Protocol) -> frozenset[str]:
    """The names of the fields that are bytes or several numbers, which are text in a row."""
    data: list[DataSpec] = [*protocol.instructions]
    data += [spec.answer for spec in protocol.instructions if spec.answer]
    return frozenset(part.name for spec in data for part in spec.fields if part.many)


def _fields(protocol: Protocol) -> list[Column]:
    """A column for each field of the instructions and answers; fields of one name share one."""
    parts = [part for spec in protocol.instructions for part in spec.fields]
    answered = [spec.answer.fields for spec in protocol.instructions if spec.answer]
    parts += chain.from_iterable(answered)
    names = dict.fromkeys(part.name for part in parts if part.constant is None)
    names |= dict.fromkeys(protocol.named_registers)
    several = bytes_fields(protocol)

    def field(name: str) -> Column:
        def value(line: JsonLine) -> Value:
            found = line.fields.get(name)
            if name not in several or found is None:
                return found
            return " ".join(map(str, found)) if isinstance(found, list) else str(found)

        return Column(name, name, max(5, len(name)), value, right=name not in several)

    return [field(name) for name in names]


class ColumnError(UserError, ValueError):
    """A column was asked for that is none. The message is one sentence."""


def chosen_columns(names: str, known: Mapping[str, Column]) -> tuple[Column, ...]:
    """The columns that `--columns` asks for: names with commas between, in any case.

    `known` are all that there are, as `columns_of` has them. Raises ColumnError for a name that is
    no column, and where one is named twice.
    """
    by_lower = {name.lower(): column for name, column in reversed([*known.items()])}
    chosen: dict[str, Column] = {}
    for name in (word.strip() for word in names.split(",")):
        column = known.get(name) or by_lower.get(name.lower())
        if column is None:
            close = near(name, known)
            hint = f", did you mean {close}?" if close else f"; there are {', '.join(known)}"
            raise ColumnError(f"there is no column {printable(name)!r}{hint}")
        if column.name in chosen:
            raise ColumnError(f"the column {column.name} is named twice")
        chosen[column.name] = column
    return tuple(chosen.values())


class RowStyle(NamedTuple):
    """What was asked for of each row: `--time` and `--columns`; None for what was not."""

    time: TimeStyle | None = None
    columns: tuple[Column, ...] | None = None

    def times(self, start_wall: int) -> Times:
        """The times of a recording that began at this time (ns since 1970)."""
        return Times(self.time or TimeStyle.RELATIVE, start_wall)


class ColumnLines:
    """Renders records as lines of chosen columns; what has no row has no line.

    `colour` paints the rows with anomalies by their severity, which only a terminal should get.
    """

    def __init__(self, columns: Sequence[Column], times: Times, *, colour: bool) -> None:
        self._columns = columns
        self._times = times
        self._colour = colour

    def text(self, records: Iterable[Record]) -> str:
        """The lines of the records, each with its newline."""
        return "".join(
            self._line(record, line) for record in records if (line := json_line(record))
        )

    def _line(self, record: Record, line: JsonLine) -> str:
        cells = []
        for column in self._columns:
            if column is TIME:  # which makes the row the one before the next, for `delta`
                cells.append(self._times.padded(nanoseconds(line.t)))
                continue
            cell = column.text(column.value(line))
            cells.append(cell.rjust(column.width) if column.right else cell.ljust(column.width))
        text, severity = "  ".join(cells).rstrip(), severity_of(record)
        return f"{painted(text, severity) if self._colour and severity else text}\n"


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
