"""`bilprov export`: writes what a capture holds for other programs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import click

from bilprov.analyzer.cli.command import argument, command, group, option
from bilprov.analyzer.cli.options import (
    RowOptions,
    WindowOptions,
    asked_here,
    compiled,
    filter_option,
)
from bilprov.analyzer.cli.output_files import STANDARD_OUTPUT, force_option, require_writable
from bilprov.analyzer.cli.reading import opened_captures, reading
from bilprov.spec.errors import UserError

if TYPE_CHECKING:
    from bilprov.analyzer.output.row_columns import RowStyle


class Format(NamedTuple):
    """A format: whether a terminal can show it (`text`), and what it has a choice of."""

    text: bool = False
    columns: bool = False
    times: bool = False


FORMATS = {
    "csv": Format(text=True, columns=True, times=True),
    "jsonl": Format(text=True),
    "parquet": Format(columns=True),
    "pcapng": Format(),
}


@dataclass(frozen=True)
class ExportOptions:
    """The options of `export`."""

    path: str | None = argument(metavar="[FILE.mcap]", required=False)
    style: str | None = option(
        "--format",
        metavar="FORMAT",
        type=click.Choice(list(FORMATS)),
        help=f"What is written: {', '.join(FORMATS)}. Without it the ending of OUT's name decides.",
    )
    output: str | None = option(
        "-o", "--output", metavar="OUT", help="The file to write; - is standard output."
    )
    expression: str | None = filter_option()
    span: WindowOptions = group(WindowOptions)
    rows: RowOptions = group(RowOptions)
    force: bool = force_option()


@command(ExportOptions)
def export(options: ExportOptions) -> None:
    """Examples:
      bilprov export drive.mcap -o drive.csv
      bilprov export drive.mcap --filter faulty --format jsonl -o -

    csv, jsonl and parquet have a row for each frame, answer and fault, decoded as replay shows
    them; docs/times.md explains their columns. pcapng has a packet for each frame, answer and line
    event, for Wireshark; bilprov spec emit wireshark writes the dissector. Memory does not grow
    with the capture. OUT appears when it is complete.
    """
    from bilprov.analyzer.replay.capture_decoding import Chosen, require_begun

    path, output = options.path, options.output
    if path is None or output is None:
        raise click.UsageError(
            "name what to write and where: bilprov export FILE.mcap -o OUT.csv (- is standard "
            "output)"
        )
    style = options.style or Path(output).suffix.removeprefix(".").lower()
    if style not in FORMATS:
        raise click.UsageError(
            f"-o {output} names no format: let it end in .{', .'.join(FORMATS)}, or add --format "
            f"{'|'.join(FORMATS)}"
        )
    form = FORMATS[style]
    window = options.span.window()
    (capture,), protocol = opened_captures([path])
    more = _choices(form, style, options.rows.style(protocol))
    test = compiled(options.expression, protocol)
    require_begun(capture, window.first)
    write = _writer(style)
    started = test and test.started(capture.start)
    with (
        _opened(output, [path], options.force, text=form.text) as stream,
        reading([capture]) as progress,
    ):
        write(Chosen(capture, protocol, started, window, progress), stream, **more)


def _writer(style: str) -> Callable[..., None]:
    """The writer of a format, imported now.

    It is called with what is Chosen, a binary stream, and `rows` if it has a choice of columns.
    """
    if style == "parquet":
        from bilprov.analyzer.export.rows import write_parquet

        return write_parquet
    if style == "pcapng":
        from bilprov.analyzer.export.pcapng import write_pcapng

        return write_pcapng
    from bilprov.analyzer.export.rows import write_csv, write_jsonl

    return write_csv if style == "csv" else write_jsonl


def _choices(form: Format, style: str, rows: RowStyle) -> dict[str, RowStyle]:
    """The arguments of a writer that has a choice of columns. Raises UsageError for one more."""
    for parameter, able in (("columns", "columns"), ("time_style", "times")):
        if asked_here(parameter) and not getattr(form, able):
            others = " and ".join(name for name, one in FORMATS.items() if getattr(one, able))
            spelling = parameter.removesuffix("_style")
            raise click.UsageError(f"--{spelling} is for {others}, not for {style}")
    return {"rows": rows} if form.columns else {}


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
