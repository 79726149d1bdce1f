"""The commands `stats` and `plot`: counts over whole captures, and a page along one's time."""

from __future__ import annotations

from dataclasses import dataclass

from bilprov.analyzer.cli.command import argument, command, option
from bilprov.analyzer.cli.options import compiled, filter_option, half_duplex_option
from bilprov.analyzer.cli.output_files import (
    STANDARD_OUTPUT,
    force_option,
    json_object,
    json_option,
    require_writable,
    write_output,
)
from bilprov.analyzer.cli.reading import opened_captures, reading


@dataclass(frozen=True)
class StatsOptions:
    """The options of `stats`."""

    files: tuple[str, ...] = argument(metavar="FILE.mcap...", nargs=-1, required=True)
    expression: str | None = filter_option()
    json_file: str | None = json_option()
    csv_file: str | None = option(
        "--csv",
        metavar="FILE",
        help="Write everything as one CSV table (file, group, key, measure, value); - is standard "
        "output.",
    )
    half_duplex: bool = half_duplex_option()
    force: bool = force_option()


@command(StatsOptions)
def stats(options: StatsOptions) -> None:
    """Examples:
      bilprov stats drive.mcap
      bilprov stats monday.mcap tuesday.mcap --json week.json

    Counted are frames, answers, anomalies, latencies, load and time moving. Each capture is decoded
    from its raw bytes, as replay does, and counted by itself; where there are several, all of them
    together too. The keys of the JSON and the CSV are explained in
    analyzer/output/capture_stats.py. With --filter only what passes is counted, from the first such
    byte to the last.
    """
    from bilprov.analyzer.output.capture_stats import file_stats, stats_csv, stats_of
    from bilprov.analyzer.output.console import show
    from bilprov.analyzer.output.stats_tables import drawn
    from bilprov.analyzer.replay.capture_decoding import capture_line, capture_totals
    from bilprov.analyzer.totals.totals import Totals

    named = {"--json": options.json_file, "--csv": options.csv_file}
    outputs = [(option, path) for option, path in named.items() if path is not None]
    require_writable(outputs, inputs=options.files, force=options.force)
    captures, protocol = opened_captures(options.files, half_duplex=options.half_duplex)
    test = compiled(options.expression, protocol)
    each, together = [], Totals(protocol)
    with reading(captures) as progress:
        for capture in captures:
            started = test and test.started(capture.start)
            totals = capture_totals(capture, protocol, progress, started)
            together.merge(totals)
            each.append(file_stats(capture, totals, capture_line(capture, protocol)))
    found = stats_of(protocol, each, together, options.expression)
    if options.json_file is not None:
        write_output(options.json_file, json_object(found))
    if options.csv_file is not None:
        write_output(options.csv_file, stats_csv(found).encode())
    if STANDARD_OUTPUT not in named.values():
        show(*drawn(found, moves=protocol.at_rest is not None))


@dataclass(frozen=True)
class PlotOptions:
    """The options of `plot`."""

    file: str = argument(metavar="FILE.mcap")
    page: str = option(
        "--html", metavar="OUT.html", required=True, help="The page to write; - is standard output."
    )
    half_duplex: bool = half_duplex_option()
    force: bool = force_option()


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

    require_writable([("--html", options.page)], inputs=[options.file], force=options.force)
    (capture,), protocol = opened_captures([options.file], half_duplex=options.half_duplex)
    totals, timeline = Totals(protocol), Timeline(protocol)
    with reading([capture]) as progress:
        for batch in opened_whole(capture, protocol).decoded(progress):
            totals.add(batch)
            timeline.add(batch)
    stats = file_stats(capture, totals, capture_line(capture, protocol))
    page = plot_page(capture, protocol, timeline, stats, kit_version())
    write_output(options.page, page.encode())
