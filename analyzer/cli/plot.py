"""The command `plot`: a capture along its time, as one HTML page."""

from __future__ import annotations

import click

from bilprov.analyzer.cli.options import note
from bilprov.analyzer.cli.output_files import force_option, require_writable, write_output
from bilprov.analyzer.cli.progress import reading


@click.command()
@click.argument("file", metavar="FILE.mcap")
@click.option(
    "--html",
    "page",
    metavar="OUT.html",
    required=True,
    help="The page to write; - is standard output.",
)
@force_option
@click.pass_obj
def plot(grammar: str | None, file: str, page: str, force: bool) -> None:
    """Draw a capture over time, as one page that loads nothing from elsewhere.

    Examples:
      bilprov plot drive.mcap --html drive.html

    Motion, speed and steering as the instructions predict them, anomalies with their reasons, and
    latencies share one time axis, which the mouse wheel, touch and keys zoom. A long time without
    traffic is folded there, with its duration beside the break. A long recording is reduced to
    steps of time, as the page then states, so that it has a few MB at most.
    """
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.analyzer.output.capture_stats import file_stats
    from bilprov.analyzer.plot.page import plot_page
    from bilprov.analyzer.replay.capture_parts import decoded_batches
    from bilprov.analyzer.replay.capture_session import capture_line, said_about
    from bilprov.analyzer.totals.timeline import Timeline
    from bilprov.analyzer.totals.totals import Totals
    from bilprov.analyzer.version import kit_version
    from bilprov.captures.reader import open_capture

    require_writable([("--html", page)], inputs=[file], force=force)
    protocol = load_protocol(grammar)
    capture = open_capture(file)
    for sentence in said_about(capture, protocol):
        note(sentence)
    totals, timeline = Totals(protocol), Timeline(protocol)
    with reading([capture]) as progress:
        for batch in decoded_batches(capture, protocol, progress):
            totals.add(batch)
            timeline.add(batch)
    stats = file_stats(capture, totals, capture_line(capture, protocol))
    write_output(page, plot_page(capture, protocol, timeline, stats, kit_version()).encode())
