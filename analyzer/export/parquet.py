"""Writes the rows of a capture as an Apache Parquet file, for pandas, DuckDB and their like.

The columns have the names and values of CSV, with types: `t` and `latency` are seconds (double),
`t_ns` and `latency_ns` whole nanoseconds, `time` is the wall clock in UTC to the nanosecond,
`bytes` are the bytes of `hex`, `faults` a list. Words that come again and again are a dictionary.
pyarrow writes it, which is an extra of the kit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, BinaryIO

from bilprov.analyzer.columns.decoder import Part
from bilprov.analyzer.export.decoding import Progress, decoded_parts
from bilprov.analyzer.output.csv_text import usual_columns
from bilprov.analyzer.output.json_lines import JsonLine, json_line
from bilprov.analyzer.output.outputs import Window
from bilprov.analyzer.output.row_columns import COLUMNS, Column, RowStyle, nanoseconds
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture
from bilprov.captures.text import escape_controls, printable
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.output.filter import Filter

ROWS = 1 << 16
"""Rows of a row group, which is what a writer and a reader hold in memory."""

_WORDS = {"direction", "kind", "name", "judgement", "response", "state.motion"}
_SECONDS = {"t", "latency"}
_TRUTHS = {"state.moving", "agrees"}
_TEXTS = {"hex", "data", "fields", "state", "reason"}


class NoPyarrow(UserError):
    """pyarrow is not installed. The message says how it comes."""


def write_parquet(
    capture: Capture,
    protocol: Protocol,
    stream: BinaryIO,
    *,
    test: Filter | None,
    window: Window,
    progress: Progress,
    rows: RowStyle = RowStyle(),  # noqa: B008
) -> None:
    """Write the rows in `window` that pass `test` as a Parquet file in row groups of 65,536.

    Arguments and errors are those of `write_csv`. Raises NoPyarrow as well, and CaptureError for a
    time that the format cannot hold.
    """
    pa, parquet = _pyarrow()
    columns = rows.columns or _usual_columns(protocol)
    schema = pa.schema([pa.field(column.name, _type(pa, column)) for column in columns])
    makers = [_values(capture, column) for column in columns]
    with parquet.ParquetWriter(stream, schema, compression="zstd") as writer:
        for lines in _groups(decoded_parts(capture, protocol, test, window, progress)):
            try:
                arrays = [
                    pa.array([value(line) for line in lines], field.type)
                    for value, field in zip(makers, schema, strict=True)
                ]
            except (OverflowError, pa.ArrowInvalid) as error:
                raise CaptureError(
                    f"{printable(capture.path)} has a time that is out of the range of Parquet "
                    "(1677 to 2262): export it as csv or jsonl"
                ) from error
            writer.write_batch(pa.record_batch(arrays, schema=schema), ROWS)


def _pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise NoPyarrow(
            "parquet needs pyarrow, which is not installed: pip install 'bilprov[parquet]'"
        ) from error
    return pyarrow, parquet


def _usual_columns(protocol: Protocol) -> tuple[Column, ...]:
    """Those of CSV, and beside them the wall clock, whole nanoseconds, and the bytes."""
    columns = [COLUMNS["time"]]
    for column in usual_columns(protocol):
        columns.append(column)
        if column.name in _SECONDS:
            columns.append(COLUMNS[f"{column.name}_ns"])
        elif column.name == "hex":
            columns.append(COLUMNS["bytes"])
    return tuple(columns)


def _groups(parts: Iterable[Part]) -> Iterable[Sequence[JsonLine]]:
    """The rows of the parts, so many at a time as a row group has."""
    lines: list[JsonLine] = []
    for part in parts:
        for record in part.records():
            line = json_line(record)
            if line is not None:
                lines.append(line)
            if len(lines) == ROWS:
                yield lines
                lines = []
    if lines:
        yield lines


def _type(pa: Any, column: Column) -> Any:
    name = column.name
    if name == "time":
        return pa.timestamp("ns", "UTC")
    if name == "bytes":
        return pa.binary()
    if name == "faults":
        return pa.list_(pa.string())
    if name in _SECONDS:
        return pa.float64()
    if name in _TRUTHS:
        return pa.bool_()
    if name in _WORDS:
        return pa.dictionary(pa.int32(), pa.string())
    return pa.string() if name in _TEXTS else pa.int64()


def _values(capture: Capture, column: Column) -> Callable[[JsonLine], Any]:
    """What stands in a column of the table for a row."""
    start, value = capture.start, column.value
    if column.name == "time":
        return lambda line: start + nanoseconds(line.t)
    if column.name == "bytes":
        return lambda line: bytes.fromhex(line.hex)
    if column.name == "faults":
        return lambda line: line.faults
    if column.name in _TEXTS | _WORDS:
        return lambda line: _text(value(line))
    return value


def _text(value: Any) -> str | None:
    return None if value is None else escape_controls(value)
