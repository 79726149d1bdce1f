"""The commands `stats`, `plot` and `export`: a capture as counts, as a page, as other files."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

import click
import msgspec

from bilprov.analyzer.cli import command_files
from bilprov.analyzer.cli import options as shared
from bilprov.analyzer.cli.command import argument, command, group, option, refuse

if TYPE_CHECKING:
    from bilprov.analyzer.totals.totals import Totals
    from bilprov.captures.reader import Capture
    from bilprov.spec.protocol import Protocol


class StatsOptions(msgspec.Struct, frozen=True):
    """The options of `stats`."""

    files: tuple[str, ...] = argument(metavar="FILE.mcap...", nargs=-1, required=True)
    expression: str | None = shared.filter_option()
    json_file: str | None = command_files.json_option()
    half_duplex: bool = shared.half_duplex_option()
    force: bool = command_files.force_option()


@command(StatsOptions, only_with={"json_file": ("force",)})
def stats(options: StatsOptions) -> None:
    """Examples:
      bilprov stats drive.mcap
      bilprov stats monday.mcap tuesday.mcap --json week.json

    Counted are frames, answers, anomalies, latencies, load and time moving. Each capture is decoded
    from its raw bytes, as replay does, and counted by itself; where there are several, all of them
    together too. The keys of the JSON are explained in
    analyzer/output/capture_stats.py. With --filter only what passes is counted, from the first such
    byte to the last.
    """
    from bilprov.analyzer.output.capture_stats import file_stats, stats_of
    from bilprov.analyzer.output.console import show
    from bilprov.analyzer.output.stats_tables import drawn
    from bilprov.analyzer.replay.capture_decoding import capture_line
    from bilprov.analyzer.totals.totals import Totals

    json_file = options.json_file
    command_files.require_writable(
        [("--json", json_file)], inputs=options.files, force=options.force
    )
    protocol, counted = _counted(options)
    each, together = [], Totals(protocol)
    for capture, totals in counted:
        together.merge(totals)
        each.append(file_stats(capture, totals, capture_line(capture, protocol)))
    found = stats_of(protocol, each, together, options.expression)
    if json_file is not None:
        command_files.write_output(json_file, command_files.json_object(found))
    if json_file != command_files.STANDARD_OUTPUT:
        show(*drawn(found, moves=protocol.at_rest is not None))


def _counted(options: StatsOptions) -> tuple[Protocol, list[tuple[Capture, Totals]]]:
    """Count captures while they are surveyed; afterwards, if all of one must be known before."""
    from bilprov.analyzer.replay.capture_decoding import capture_settings, said_about
    from bilprov.captures.reader import open_front

    if not options.half_duplex:
        command_files.keep_memory()
        fronts = [open_front(path) for path in options.files]
        protocol = command_files.protocol_of(*fronts)
        found = _totals(options, fronts, protocol)
        wholes = [(front, front.whole()) for front in fronts]
        captures = [
            whole
            for front, whole in wholes
            if whole and capture_settings(whole, protocol) == capture_settings(front, protocol)
        ]
        if len(captures) == len(fronts):
            for capture in captures:
                shared.note(*said_about(capture, protocol))
            return protocol, list(zip(captures, found, strict=True))
    captures, protocol = command_files.opened_captures(
        options.files, half_duplex=options.half_duplex
    )
    return protocol, list(zip(captures, _totals(options, captures, protocol), strict=True))


def _totals(options: StatsOptions, captures: Sequence[Capture], protocol: Protocol) -> list[Totals]:
    from bilprov.analyzer.replay.capture_decoding import capture_totals

    test = shared.compiled(options.expression, protocol)
    with command_files.reading(captures) as progress:
        return [
            capture_totals(capture, protocol, progress, test and test.started(capture.start))
            for capture in captures
        ]


class PlotOptions(msgspec.Struct, frozen=True):
    """The options of `plot`."""

    file: str = argument(metavar="FILE.mcap")
    page: str = option(
        "--html", metavar="OUT.html", required=True, help="The page to write; - is standard output."
    )
    half_duplex: bool = shared.half_duplex_option()
    force: bool = command_files.force_option()


@command(PlotOptions)
def plot(options: PlotOptions) -> None:
    """Examples:
      bilprov plot drive.mcap --html drive.html

    The page loads nothing from elsewhere. Motion, speed and steering as the instructions predict
    them, anomalies with their reasons, and latencies share one time axis, which the mouse wheel,
    touch and keys zoom. A long time without traffic is folded there, with its duration beside the
    break. A long recording is reduced to steps of time, as the page then states, so that it has a
    few MB at most.
    """
    from bilprov.analyzer.output.capture_stats import file_stats
    from bilprov.analyzer.plot.page import plot_page
    from bilprov.analyzer.replay.capture_decoding import capture_line, opened_whole
    from bilprov.analyzer.totals.timeline import Timeline
    from bilprov.analyzer.totals.totals import Totals
    from bilprov.analyzer.version import kit_version

    command_files.require_writable(
        [("--html", options.page)], inputs=[options.file], force=options.force
    )
    (capture,), protocol = command_files.opened_captures(
        [options.file], half_duplex=options.half_duplex
    )
    totals, timeline = Totals(protocol), Timeline(protocol)
    with command_files.reading([capture]) as progress:
        for batch in opened_whole(capture, protocol).decoded(progress):
            totals.add(batch)
            timeline.add(batch)
    stats = file_stats(capture, totals, capture_line(capture, protocol))
    page = plot_page(capture, protocol, timeline, stats, kit_version())
    command_files.write_output(options.page, page.encode())


FORMATS = ("csv", "jsonl", "parquet", "pcapng")
TEXTS = ("csv", "jsonl")  # what a terminal can show
CHOICES = {"columns": ("csv", "parquet"), "time_style": ("csv",)}
"""The formats that have a choice of these parameters."""


class ExportOptions(msgspec.Struct, frozen=True):
    """The options of `export`."""

    path: str = argument(metavar="FILE.mcap")
    style: str | None = option(
        "--format",
        metavar="FORMAT",
        type=click.Choice(list(FORMATS)),
        help=f"What is written: {', '.join(FORMATS)}. Without it the ending of OUT's name decides.",
    )
    output: str = shared.output_option(
        metavar="OUT", required=True, help="The file to write; - is standard output."
    )
    expression: str | None = shared.filter_option()
    span: shared.WindowOptions = group(shared.WindowOptions)
    rows: shared.RowOptions = group(shared.RowOptions)
    half_duplex: bool = shared.half_duplex_option()
    force: bool = command_files.force_option()


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
        if style not in able:
            refuse([parameter], f"is for {' and '.join(able)}, not for {style}")
    window = options.span.window()
    (capture,), protocol = command_files.opened_captures([path], half_duplex=options.half_duplex)
    chosen_rows = options.rows.style(protocol)
    test = shared.compiled(options.expression, protocol)
    require_begun(capture, window.first)
    started = test and test.started(capture.start)
    if output == command_files.STANDARD_OUTPUT and style not in TEXTS and sys.stdout.isatty():
        raise click.UsageError("-o - is a terminal, and this is not text: name a file")
    command_files.require_writable([("-o", output)], [path], force=options.force)
    with (
        command_files.opened_file(output, replace=options.force) as stream,
        command_files.reading([capture]) as progress,
    ):
        chosen = rows.Chosen(capture, protocol, started, window, progress, chosen_rows)
        if style == "pcapng":
            pcapng.write_pcapng(chosen, stream)
        elif style == "parquet":
            rows.write_parquet(chosen, stream)
        else:
            rows.write_text(chosen, stream, cast(Literal["csv", "jsonl"], style))
