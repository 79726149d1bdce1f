"""`bilprov export`: writes what a capture holds for other programs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import click

from bilprov.analyzer.cli.options import (
    Finite,
    asked_here,
    compiled,
    filter_option,
    note,
    row_options,
    row_style,
)
from bilprov.analyzer.cli.output_files import STANDARD_OUTPUT, force_option, require_writable
from bilprov.analyzer.cli.progress import reading
from bilprov.spec.errors import UserError

if TYPE_CHECKING:
    from bilprov.analyzer.output.outputs import Window
    from bilprov.analyzer.output.row_columns import RowStyle
    from bilprov.captures.reader import Capture
    from bilprov.spec.protocol import Protocol


class Format(NamedTuple):
    """A format: how its writer is imported, and what it has a choice of.

    A writer is called with a capture, a protocol, a binary stream, and by keyword `test` (a Filter
    or None), `window`, `progress` (told the bytes of the line that were read more), and `rows` if
    it has a choice of columns. `text` is true if a terminal can show it.
    """

    writer: Callable[[], Callable[..., None]]
    text: bool = False
    columns: bool = False
    times: bool = False


def _csv() -> Callable[..., None]:
    from bilprov.analyzer.export.text import write_csv

    return write_csv


def _jsonl() -> Callable[..., None]:
    from bilprov.analyzer.export.text import write_jsonl

    return write_jsonl


def _parquet() -> Callable[..., None]:
    from bilprov.analyzer.export.parquet import write_parquet

    return write_parquet


def _pcapng() -> Callable[..., None]:
    from bilprov.analyzer.export.pcapng import write_pcapng

    return write_pcapng


FORMATS = {
    "csv": Format(_csv, text=True, columns=True, times=True),
    "jsonl": Format(_jsonl, text=True),
    "parquet": Format(_parquet, columns=True),
    "pcapng": Format(_pcapng),
}


@click.command()
@click.argument("path", metavar="[FILE.mcap]", required=False)
@click.option(
    "--format",
    "style",
    metavar="FORMAT",
    type=click.Choice(list(FORMATS)),
    help=f"What is written: {', '.join(FORMATS)}. Without it the ending of OUT's name decides.",
)
@click.option("-o", "--output", metavar="OUT", help="The file to write; - is standard output.")
@filter_option
@click.option("--start", type=Finite(0), help="Begin at this second of the capture.")
@click.option("--end", type=Finite(0), help="End before this second of the capture.")
@row_options
@force_option
@click.pass_obj
def export(
    grammar: str | None,
    path: str | None,
    style: str | None,
    output: str | None,
    expression: str | None,
    start: float | None,
    end: float | None,
    time_style: str | None,
    columns: str | None,
    force: bool,
) -> None:
    """Write the contents of a capture for other programs.

    Examples:
      bilprov export drive.mcap -o drive.csv
      bilprov export drive.mcap --filter faulty --format jsonl -o -

    csv, jsonl and parquet have a row for each frame, answer and fault, decoded as replay shows
    them; docs/times.md explains their columns. pcapng has a packet for each frame, answer and
    line event, for Wireshark; bilprov spec emit wireshark writes the dissector. Memory does not
    grow with the capture. OUT appears when it is complete.
    """
    from bilprov.analyzer.grammar_file import load_protocol

    protocol = load_protocol(grammar)
    if path is None or output is None:
        raise click.UsageError(
            "name what to write and where: bilprov export FILE.mcap -o OUT.csv (- is standard "
            "output)"
        )
    style = style or Path(output).suffix.removeprefix(".").lower()
    if style not in FORMATS:
        raise click.UsageError(
            f"-o {output} names no format: let it end in .{', .'.join(FORMATS)}, or add --format "
            f"{'|'.join(FORMATS)}"
        )
    form = FORMATS[style]
    more = _choices(form, style, row_style(time_style, columns, protocol))
    window = _window(start, end)
    test = compiled(expression, protocol)
    capture = _capture(path, protocol, window)
    with (
        _opened(output, [path], force, text=form.text) as stream,
        reading([capture]) as progress,
    ):
        form.writer()(
            capture,
            protocol,
            stream,
            test=test.started(capture.start) if test else None,
            window=window,
            progress=progress,
            **more,
        )


def _choices(form: Format, style: str, rows: RowStyle) -> dict[str, RowStyle]:
    """The arguments of a writer that has a choice of columns. Raises UsageError for one more."""
    for option, parameter, able in (
        ("--columns", "columns", {name: row.columns for name, row in FORMATS.items()}),
        ("--time", "time_style", {name: row.times for name, row in FORMATS.items()}),
    ):
        if asked_here(parameter) and not able[style]:
            others = " and ".join(name for name in able if able[name])
            raise click.UsageError(f"{option} is for {others}, not for {style}")
    return {"rows": rows} if form.columns else {}


def _window(start: float | None, end: float | None) -> Window:
    from bilprov.analyzer.output.outputs import Window

    if start is not None and end is not None and end <= start:
        raise click.UsageError(f"--end {end:g} is not after --start {start:g}")
    return Window(*(None if s is None else round(s * 1e9) for s in (start, end)))


def _capture(path: str, protocol: Protocol, window: Window) -> Capture:
    """Open a capture and tell what there is to tell about it."""
    from bilprov.analyzer.replay.capture_session import require_begun, said_about
    from bilprov.captures.reader import open_capture

    capture = open_capture(path)
    for sentence in said_about(capture, protocol):
        note(sentence)
    require_begun(capture, window.first)
    return capture


@contextmanager
def _opened(output: str, inputs: list[str], force: bool, *, text: bool) -> Iterator[BinaryIO]:
    """Open the file OUT, which is there only if the block ends well; or standard output.

    Raises UsageError, in one sentence, if it may not be written, and UserError if it cannot be.
    """
    from bilprov.analyzer.files import whole_file

    if output == STANDARD_OUTPUT:
        if not text and sys.stdout.isatty():
            raise click.UsageError("-o - is a terminal, and this is not text: name a file")
        yield sys.stdout.buffer
        sys.stdout.buffer.flush()
        return
    require_writable([("-o", output)], inputs, force=force)
    try:
        with whole_file(Path(output), replace=force) as stream:
            yield stream
    except OSError as error:
        why = error.strerror or error
        raise UserError(f"{output} cannot be written: {why}") from error
