"""Writes the rows of a capture: as CSV, as JSON lines, or as an Apache Parquet file.

Parquet is for pandas, DuckDB and their like. The columns have the names and values of CSV, with
types: `t` and `latency` are seconds (double), `t_ns` and `latency_ns` whole nanoseconds, `time` is
the wall clock in UTC to the nanosecond, `bytes` are the bytes of `hex`, `faults` a list. Words that
come again and again are a dictionary; a field or state that 64 bits cannot hold is a decimal of 38
digits. pyarrow, which writes it, is an extra of the kit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, NamedTuple

from bilprov.analyzer.decode.json_lines import JsonLine, json_line
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.filters.fields import Kind, fields_of
from bilprov.analyzer.output.outputs import Output, Shown, Window, opened_output
from bilprov.analyzer.output.row_columns import COLUMNS, Column, RowStyle, converted, usual_columns
from bilprov.analyzer.replay.capture_decoding import TEXT_BATCH, Progress, opened_whole
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture
from bilprov.captures.text import escape_controls, printable
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch
    from bilprov.analyzer.filters.filter import Filter


class Chosen(NamedTuple):
    """What of a capture is exported: the rows in a window that pass a filter (None: all)."""

    capture: Capture
    protocol: Protocol
    test: Filter | None
    window: Window
    progress: Progress
    rows: RowStyle = RowStyle()

    def batches(self) -> Iterator[Batch]:
        """Yield the rows. Raises CaptureError if the capture cannot be read."""
        shown = Shown(Output(), self.test, window=self.window)
        opened = opened_whole(self.capture, self.protocol)
        return map(shown.show, opened.decoded(self.progress, self.window, TEXT_BATCH))


def write_text(chosen: Chosen, stream: BinaryIO, style: Literal["csv", "jsonl"]) -> None:
    """Write the chosen rows as CSV or as JSON lines in UTF-8; see `row_columns`, `json_lines`.

    Raises OSError if the stream cannot be written, CaptureError if the capture cannot be read.
    """

    def write(text: str) -> None:
        stream.write(text.encode("utf-8", "backslashreplace"))

    output = opened_output(style, chosen.protocol, chosen.rows, chosen.capture.start, write)
    for batch in chosen.batches():
        output.show(batch)


ROWS = 1 << 16
"""Rows of a row group at most, which is what a reader holds in memory."""

_MOST = 1 << 63
# Text that may need escapes.
_FOREIGN = {"name", "judgement", "response", "fields", "state", "reason"}


class NoPyarrow(UserError):
    """pyarrow is not installed. The message says how it comes."""


def write_parquet(chosen: Chosen, stream: BinaryIO) -> None:
    """Write the chosen rows as a Parquet file.

    Raises as `write_text`; NoPyarrow as well, and CaptureError for a time that the format cannot
    hold.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise NoPyarrow(
            "parquet needs pyarrow, which is not installed: pip install 'bilprov[parquet]'"
        ) from error
    capture = chosen.capture
    columns = chosen.rows.columns or _usual_columns(chosen.protocol)
    schema = pa.schema([(one.name, _type(pa, one.name, chosen.protocol)) for one in columns])
    with parquet.ParquetWriter(stream, schema, compression="zstd") as writer:
        waiting: list[Any] = []
        for batch in chosen.batches():
            arrays = _arrays(pa, batch.records(), columns, schema, capture.start)
            try:
                waiting.append(pa.record_batch(list(arrays), schema=schema))
            except (OverflowError, pa.ArrowInvalid) as error:
                raise CaptureError(
                    f"{printable(capture.path)} has a time that is out of the range of Parquet "
                    "(1677 to 2262): export it as csv or jsonl"
                ) from error
            if sum(one.num_rows for one in waiting) >= ROWS:
                _write(pa, writer, waiting)
        _write(pa, writer, waiting)


def _write(pa: Any, writer: Any, waiting: list[Any]) -> None:
    """Write what waits, if anything does, as row groups."""
    whole = pa.Table.from_batches(waiting, writer.schema).unify_dictionaries()
    waiting.clear()
    if whole.num_rows:
        writer.write_table(whole, row_group_size=ROWS)


def _arrays(
    pa: Any, records: Iterable[Record], columns: Iterable[Column], schema: Any, start: int
) -> Iterator[Any]:
    """Yield an array for each column. Raises OverflowError or ArrowInvalid for a time too far."""
    rows = [(line, record.t) for record in records if (line := json_line(record))]
    lines, times = [line for line, _ in rows], [t for _, t in rows]
    for column, field in zip(columns, schema, strict=True):
        yield pa.array(_values(column, lines, times, start), field.type)


def _values(
    column: Column, lines: Sequence[JsonLine], times: Sequence[int], start: int
) -> Sequence[Any]:
    """The values of a column in lines at these times (ns), of a capture that began at `start`."""
    name = column.name
    if name == "time":
        return [start + t for t in times]
    if name == "t_ns":
        return times
    if name == "faults":
        return [line.faults for line in lines]
    values = list(map(column.value, lines))
    if name == "bytes":
        return converted(values, bytes.fromhex)
    return converted(values, _harmless) if name in _FOREIGN else values


def _usual_columns(protocol: Protocol) -> tuple[Column, ...]:
    """Those of CSV, and beside them the wall clock, whole nanoseconds, and the bytes."""
    columns = [COLUMNS["time"]]
    for column in usual_columns(protocol):
        columns.append(column)
        if column.name in ("t", "latency"):
            columns.append(COLUMNS[f"{column.name}_ns"])
        elif column.name == "hex":
            columns.append(COLUMNS["bytes"])
    return tuple(columns)


def _type(pa: Any, name: str, protocol: Protocol) -> Any:
    """The type of a column, by the kind of value that a filter knows it as."""
    whole, text, words = pa.int64(), pa.string(), pa.dictionary(pa.int32(), pa.string())
    own = {
        "time": pa.timestamp("ns", "UTC"),
        "bytes": pa.binary(),
        "uncertain": pa.bool_(),
        **dict.fromkeys(("fields", "state"), text),
        **dict.fromkeys(("judgement", "response"), words),
        **dict.fromkeys(("t_ns", "latency_ns"), whole),
    }
    if name in own:
        return own[name]
    field = fields_of(protocol)[name]
    if not all(-_MOST <= end < _MOST for end in (field.low or 0, field.high or 0)):
        return pa.decimal128(38)
    return {
        Kind.SECONDS: pa.float64(),
        Kind.TRUTH: pa.bool_(),
        Kind.WORD: words,
        Kind.WORDS: pa.list_(text),
        Kind.TEXT: text,
        Kind.BYTES: text,
    }.get(field.kind, whole)


def _harmless(text: object) -> str | None:
    return None if text is None else escape_controls(str(text))
