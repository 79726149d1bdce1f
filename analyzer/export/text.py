"""Writes the rows of a capture as CSV, or as the JSON lines that `replay --format jsonl` prints."""

from __future__ import annotations

from typing import TYPE_CHECKING, BinaryIO

from bilprov.analyzer.output.csv_text import CsvText, usual_columns
from bilprov.analyzer.output.json_text import JsonText
from bilprov.analyzer.output.outputs import NoOutput, Shown, TextForm, Window
from bilprov.analyzer.output.row_columns import AS_USUAL, RowStyle
from bilprov.analyzer.replay.capture_parts import TEXT_BATCH, Progress, decoded_batches
from bilprov.captures.reader import Capture
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter


def write_csv(
    capture: Capture,
    protocol: Protocol,
    stream: BinaryIO,
    *,
    test: Filter | None,
    window: Window,
    progress: Progress,
    rows: RowStyle = AS_USUAL,
) -> None:
    """Write the rows in `window` that pass `test` as CSV in UTF-8; see `csv_text`.

    `progress` is told the bytes of each batch. Raises OSError if the stream cannot be written,
    CaptureError if the capture cannot be read.
    """
    columns = rows.columns or usual_columns(protocol, time=rows.time is not None)
    form = CsvText(columns, rows.times(capture.start))
    stream.write(form.header.encode())
    _write(capture, protocol, stream, form, test, window, progress)


def write_jsonl(
    capture: Capture,
    protocol: Protocol,
    stream: BinaryIO,
    *,
    test: Filter | None,
    window: Window,
    progress: Progress,
) -> None:
    """Write the JSON lines in `window` that pass `test`, in UTF-8; see `json_lines`.

    Arguments and errors are those of `write_csv`.
    """
    _write(capture, protocol, stream, JsonText(), test, window, progress)


def _write(
    capture: Capture,
    protocol: Protocol,
    stream: BinaryIO,
    form: TextForm,
    test: Filter | None,
    window: Window,
    progress: Progress,
) -> None:
    shown = Shown(NoOutput(), test, window=window)
    for decoded in decoded_batches(capture, protocol, progress, window, TEXT_BATCH):
        text = form.text(shown.show(decoded).records())
        stream.write(text.encode("utf-8", "backslashreplace"))
