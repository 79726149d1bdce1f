"""`bilprov export`: writes what a capture holds for other programs."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal, cast

import click

from bilprov.analyzer.cli.command import argument, command, group, option
from bilprov.analyzer.cli.options import (
    RowOptions,
    WindowOptions,
    asked_here,
    compiled,
    filter_option,
    half_duplex_option,
)
from bilprov.analyzer.cli.output_files import STANDARD_OUTPUT, force_option, require_writable
from bilprov.analyzer.cli.reading import opened_captures, reading
from bilprov.spec.errors import UserError

FORMATS = ("csv", "jsonl", "parquet", "pcapng")
TEXTS = ("csv", "jsonl")  # what a terminal can show
CHOICES = {"columns": ("csv", "parquet"), "time_style": ("csv",)}
"""The formats that have a choice of these parameters."""


@dataclass(frozen=True)
class ExportOptions:
    """The options of `export`."""

    path: str = argument(metavar="FILE.mcap")
    style: str | None = option(
        "--format",
        metavar="FORMAT",
        type=click.Choice(list(FORMATS)),
        help=f"What is written: {', '.join(FORMATS)}. Without it the ending of OUT's name decides.",
    )
    output: str = option(
        *("-o", "--output"),
        metavar="OUT",
        required=True,
        help="The file to write; - is standard output.",
    )
    expression: str | None = filter_option()
    span: WindowOptions = group(WindowOptions)
    rows: RowOptions = group(RowOptions)
    half_duplex: bool = half_duplex_option()
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
    from bilprov.analyzer.export import pcapng, rows
    from bilprov.analyzer.replay.capture_decoding import require_begun

    path, output = options.path, options.output
    style = options.style or Path(output).suffix.removeprefix(".").lower()
    if style not in FORMATS:
        raise click.UsageError(
            f"-o {output} names no format: let it end in .{', .'.join(FORMATS)}, or add --format "
            f"{'|'.join(FORMATS)}"
        )
    for parameter, able in CHOICES.items():
        if asked_here(parameter) and style not in able:
            spelling = parameter.removesuffix("_style")
            raise click.UsageError(f"--{spelling} is for {' and '.join(able)}, not for {style}")
    window = options.span.window()
    (capture,), protocol = opened_captures([path], half_duplex=options.half_duplex)
    chosen_rows = options.rows.style(protocol)
    test = compiled(options.expression, protocol)
    require_begun(capture, window.first)
    started = test and test.started(capture.start)
    with (
        _opened(output, [path], options.force, text=style in TEXTS) as stream,
        reading([capture]) as progress,
    ):
        chosen = rows.Chosen(capture, protocol, started, window, progress, chosen_rows)
        if style == "pcapng":
            pcapng.write_pcapng(chosen, stream)
        elif style == "parquet":
            rows.write_parquet(chosen, stream)
        else:
            rows.write_text(chosen, stream, cast(Literal["csv", "jsonl"], style))


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
