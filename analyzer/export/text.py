"""Writes the rows of a capture as CSV, or as the JSON lines that `replay --format jsonl` prints."""

from __future__ import annotations

from typing import BinaryIO

from bilprov.analyzer.output.csv_text import CsvText, usual_columns
from bilprov.analyzer.output.json_text import JsonText
from bilprov.analyzer.output.outputs import TextForm
from bilprov.analyzer.output.row_columns import AS_USUAL, RowStyle
from bilprov.analyzer.replay.capture_parts import Chosen


def write_csv(chosen: Chosen, stream: BinaryIO, rows: RowStyle = AS_USUAL) -> None:
    """Write the chosen rows as CSV in UTF-8; see `csv_text`.

    Raises OSError if the stream cannot be written, CaptureError if the capture cannot be read.
    """
    columns = rows.columns or usual_columns(chosen.protocol, time=rows.time is not None)
    form = CsvText(columns, rows.times(chosen.capture.start))
    stream.write(form.header.encode())
    _write(chosen, stream, form)


def write_jsonl(chosen: Chosen, stream: BinaryIO) -> None:
    """Write the chosen rows as JSON lines in UTF-8; see `json_lines`. Raises as `write_csv`."""
    _write(chosen, stream, JsonText())


def _write(chosen: Chosen, stream: BinaryIO, form: TextForm) -> None:
    for batch in chosen.batches():
        stream.write(form.text(batch.records()).encode("utf-8", "backslashreplace"))
