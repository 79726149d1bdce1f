"""Writes the rows of a capture as an Apache Parquet file, for pandas, DuckDB and their like.

The columns have the names and values of CSV, with types: `t` and `latency` are seconds (double),
`t_ns` and `latency_ns` whole nanoseconds, `time` is the wall clock in UTC to the nanosecond,
`bytes` are the bytes of `hex`, `faults` a list. Words that come again and again are a dictionary;
a field or state that 64 bits cannot hold is a decimal of 38 digits. pyarrow, which writes it, is an
extra of the kit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, BinaryIO

from bilprov.analyzer.columns.decoder import Part, Records
from bilprov.analyzer.decode.json_lines import json_line
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.output.csv_text import usual_columns
from bilprov.analyzer.output.outputs import NoOutput, Shown, Window
from bilprov.analyzer.output.row_columns import AS_USUAL, COLUMNS, Column, RowStyle
from bilprov.analyzer.replay.capture_parts import TEXT_BATCH, Progress, decoded_parts
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture
from bilprov.captures.text import escape_controls, printable
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.columns.stretch import Stretch
    from bilprov.analyzer.filters.filter import Filter

ROWS = 1 << 16
"""Rows of a row group at most, which is what a reader holds in memory."""

_INT_BYTES = 8
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
    rows: RowStyle = AS_USUAL,
) -> None:
    """Write the rows in `window` that pass `test` as a Parquet file.

    Arguments and errors are those of `write_csv`. Raises NoPyarrow as well, and CaptureError for a
    time that the format cannot hold.
    """
    pa, parquet = _pyarrow()
    columns = [_typed(column) for column in rows.columns or _usual_columns(protocol)]
    wide = _wide(protocol)
    schema = pa.schema([pa.field(one.name, _type(pa, one.name, wide)) for one in columns])
    with parquet.ParquetWriter(stream, schema, compression="zstd") as writer:
        table = _Table(pa, writer, columns, capture.start)
        shown = Shown(NoOutput(), test, window=window)
        for decoded in decoded_parts(capture, protocol, progress, window, TEXT_BATCH):
            part = shown.show(decoded)
            try:
                table.add(part)
            except (OverflowError, pa.ArrowInvalid) as error:
                raise CaptureError(
                    f"{printable(capture.path)} has a time that is out of the range of Parquet "
                    "(1677 to 2262): export it as csv or jsonl"
                ) from error
        table.write()


class _Table:
    """Collects decoded parts into the row groups of a table, and writes them."""

    def __init__(self, pa: Any, writer: Any, columns: Sequence[Column], start: int) -> None:
        self._pa = pa
        self._writer = writer
        self._schema = writer.schema
        self._columns = columns
        self._start = start
        self._waiting: list[Any] = []
        self._rows = 0

    def add(self, part: Part) -> None:
        """Add the rows of a part. Raises OverflowError or ArrowInvalid for a time out of range."""
        arrays = self._listed(part.listed) if isinstance(part, Records) else self._stretch(part)
        batch = self._pa.record_batch(list(arrays), schema=self._schema)
        self._waiting.append(batch)
        self._rows += batch.num_rows
        if self._rows >= ROWS:
            self.write()

    def write(self) -> None:
        """Write the rows that wait, if there are any."""
        if not self._rows:
            return
        whole = self._pa.Table.from_batches(self._waiting, self._schema).unify_dictionaries()
        self._writer.write_table(whole, row_group_size=ROWS)
        self._waiting, self._rows = [], 0

    def _listed(self, records: Sequence[Record]) -> Iterator[Any]:
        rows = [(record.t, line) for record in records if (line := json_line(record))]
        for column, field in zip(self._columns, self._schema, strict=True):
            if column.name == "time":
                values: list[Any] = [self._start + t for t, _ in rows]
            elif column.name == "t_ns":
                values = [t for t, _ in rows]
            else:
                values = [column.value(line) for _, line in rows]
            yield self._pa.array(values, field.type)

    def _stretch(self, stretch: Stretch) -> Iterator[Any]:
        from bilprov.analyzer.output.stretch_rows import StretchRows

        pa, rows = self._pa, StretchRows(stretch)
        for column, field in zip(self._columns, self._schema, strict=True):
            if column.name == "time":
                pa.scalar(self._start + stretch.latest, field.type)  # or the sum may wrap around
                yield pa.array(rows.t + self._start).cast(field.type)
            else:
                values, place = rows.cells(column)
                yield pa.array(values, field.type).take(pa.array(place))


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


def _wide(protocol: Protocol) -> set[str]:
    """The columns of fields and states whose numbers may not fit into 64 bits with a sign."""
    fields = {
        name
        for spec in protocol.instructions
        for part in spec.fields
        if part.size >= _INT_BYTES
        for name in (part.name, f"fields.{part.name}")
    }
    most = 1 << 8 * _INT_BYTES - 1
    return fields | {
        f"state.{name}"
        for name, (low, high) in protocol.bounds.items()
        if not -most <= low <= high < most
    }


def _type(pa: Any, name: str, wide: set[str]) -> Any:
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
    if name in _TEXTS:
        return pa.string()
    return pa.decimal128(38) if name in wide else pa.int64()


def _typed(column: Column) -> Column:
    """The column with values of its type."""
    value: Any = column.value
    typed: Any = value
    if column.name == "bytes":
        typed = lambda line: bytes.fromhex(line.hex)  # noqa: E731
    elif column.name == "faults":
        typed = lambda line: line.faults  # noqa: E731
    elif column.name in _TEXTS | _WORDS:
        typed = lambda line: _text(value(line))  # noqa: E731
    return replace(column, value=typed)


def _text(value: Any) -> str | None:
    return None if value is None else escape_controls(value)
