"""The command `stats`: counts over whole captures, for people and as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from bilprov.analyzer.cli.options import note

if TYPE_CHECKING:
    from rich.progress import Progress

    from bilprov.captures.reader import Capture

STANDARD_OUTPUT = "-"
_LONG = 4_000_000  # bytes on the line from which on progress is shown


@click.command()
@click.argument("files", metavar="FILE.mcap...", nargs=-1, required=True)
@click.option(
    "--json",
    "output",
    metavar="FILE",
    help="All of it as one JSON object; - is standard output, which then has nothing else.",
)
@click.pass_obj
def stats(grammar: str | None, files: tuple[str, ...], output: str | None) -> None:
    """Count what captures hold: frames, answers, anomalies, latencies.

    Each capture is decoded from its raw bytes, as replay does, and counted by itself; where there
    are several, all of them together too. The keys of the JSON are explained in
    analyzer/output/capture_stats.py.

    Example: bilprov stats monday.mcap tuesday.mcap --json week.json
    """
    import msgspec

    from bilprov.analyzer.columns.totals import Totals
    from bilprov.analyzer.files import write_whole
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.analyzer.output.capture_stats import drawn, file_stats, stats_of
    from bilprov.analyzer.output.console import show
    from bilprov.analyzer.replay.capture_session import said_about
    from bilprov.analyzer.replay.capture_totals import capture_totals
    from bilprov.captures.reader import open_capture

    _require_writable(output, files)
    protocol = load_protocol(grammar)
    captures = [open_capture(file) for file in files]
    for capture in captures:
        for sentence in said_about(capture, protocol):
            note(sentence)
    each, together = [], Totals(protocol)
    with _bar(captures) as bar:
        task = bar.add_task("", total=sum(map(_size, captures)))
        for capture in captures:
            totals = capture_totals(capture, protocol, lambda size: bar.advance(task, size))
            together.merge(totals)
            each.append(file_stats(capture, totals))
    found = stats_of(protocol, each, together)
    text = msgspec.json.format(msgspec.json.encode(found), indent=1) + b"\n"
    if output == STANDARD_OUTPUT:
        click.echo(text, nl=False)
        return
    if output is not None:
        write_whole(Path(output), text)
    show(*drawn(found))


def _require_writable(output: str | None, files: tuple[str, ...]) -> None:
    """Raise UsageError if the JSON cannot be written, before anything is counted."""
    from bilprov.analyzer.files import why_not_writable

    if output is None or output == STANDARD_OUTPUT:
        return
    why_not = why_not_writable(Path(output))
    if why_not:
        raise click.UsageError(f"--json {output} cannot be written: {why_not}")
    if Path(output).resolve() in {Path(file).resolve() for file in files}:
        raise click.UsageError(f"--json {output} would overwrite the capture: name another file")


def _size(capture: Capture) -> int:
    """How many bytes on the line a capture holds."""
    from bilprov.captures.topics import DEVICE_RAW, HOST_RAW

    return sum(capture.contents.sizes.get(topic, 0) for topic in (HOST_RAW, DEVICE_RAW))


def _bar(captures: list[Capture]) -> Progress:
    """A progress bar on standard error; shown on a terminal only, and only if it takes long."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TimeRemainingColumn

    console = Console(stderr=True)
    return Progress(
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal or sum(map(_size, captures)) < _LONG,
    )
