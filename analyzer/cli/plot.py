"""The command `plot`: a capture along its time, as one HTML page."""

from __future__ import annotations

from dataclasses import dataclass

from bilprov.analyzer.cli.command import argument, command, option
from bilprov.analyzer.cli.output_files import force_option, require_writable, write_output
from bilprov.analyzer.cli.reading import opened_captures, reading


@dataclass(frozen=True)
class PlotOptions:
    """The options of `plot`."""

    file: str = argument(metavar="FILE.mcap")
    page: str = option(
        "--html", metavar="OUT.html", required=True, help="The page to write; - is standard output."
    )
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
    from bilprov.analyzer.replay.capture_parts import decoded_batches
    from bilprov.analyzer.replay.capture_session import capture_line
    from bilprov.analyzer.totals.timeline import Timeline
    from bilprov.analyzer.totals.totals import Totals
    from bilprov.analyzer.version import kit_version

    require_writable([("--html", options.page)], inputs=[options.file], force=options.force)
    (capture,), protocol = opened_captures([options.file])
    totals, timeline = Totals(protocol), Timeline(protocol)
    with reading([capture]) as progress:
        for batch in decoded_batches(capture, protocol, progress):
            totals.add(batch)
            timeline.add(batch)
    stats = file_stats(capture, totals, capture_line(capture, protocol))
    page = plot_page(capture, protocol, timeline, stats, kit_version())
    write_output(options.page, page.encode())
