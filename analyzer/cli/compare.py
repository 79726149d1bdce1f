"""`bilprov compare`: tells where two captures differ, frame by frame of the host."""

from __future__ import annotations

from pathlib import Path

import click

from bilprov.analyzer.cli.edit import reading
from bilprov.analyzer.cli.options import Finite, note

STANDARD_OUTPUT = "-"


@click.command()
@click.argument("first", metavar="A.mcap")
@click.argument("second", metavar="B.mcap")
@click.option(
    "--latency",
    "tolerance",
    metavar="MS",
    type=Finite(0),
    default=20.0,
    show_default=True,
    help="By how many milliseconds the latencies of a frame may differ: an adapter alone may hold "
    "an answer back for 16.",
)
@click.option(
    "--json",
    "output",
    metavar="FILE",
    help="All of it as one JSON object; - is standard output, which then has nothing else.",
)
@click.pass_obj
def compare(
    grammar: str | None, first: str, second: str, tolerance: float, output: str | None
) -> int:
    """Tell where two captures differ.

    Both are decoded, and aligned by the frames that the host sent, so that one frame more or less
    does not shift all that follow. Told are frames that only one of them has, other or missing
    answers, bytes that nobody asked for, and latencies that differ by more than --latency; times of
    day and pauses are not compared. The keys of the JSON are explained in
    analyzer/edit/comparison_report.py.

    Exit code 1 if anything differs, 0 if nothing does, 3 if only one of them holds answers and
    nothing else differs; 2 if not all of it could be shown.

    Example: bilprov compare yesterday.mcap today.mcap
    """
    import msgspec

    from bilprov.analyzer.cli.streams import promise_verdict
    from bilprov.analyzer.edit.compare import compared
    from bilprov.analyzer.edit.comparison_report import as_json, drawn
    from bilprov.analyzer.edit.exchanges import exchanges
    from bilprov.analyzer.files import write_whole
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.analyzer.output.console import show
    from bilprov.analyzer.replay.capture_session import said_about
    from bilprov.captures.reader import open_capture

    promise_verdict()
    _require_writable(output, first, second)
    protocol = load_protocol(grammar)
    captures = [open_capture(path) for path in (first, second)]
    for capture in captures:
        for sentence in said_about(capture, protocol):
            note(sentence)
    with reading(captures) as progress:
        one, other = (exchanges(capture, protocol, progress) for capture in captures)
        comparison = compared(one, other, round(tolerance * 1e6))
    paths = (first, second)
    value = as_json(comparison, protocol, paths)
    text = msgspec.json.format(msgspec.json.encode(value), indent=1) + b"\n"
    if output == STANDARD_OUTPUT:
        click.echo(text, nl=False)
        return comparison.exit
    if output is not None:
        write_whole(Path(output), text)
    show(*drawn(comparison, paths))
    return comparison.exit


def _require_writable(output: str | None, *captures: str) -> None:
    """Raise UsageError if the JSON cannot be written, before anything is compared."""
    from bilprov.analyzer.files import real_path, why_not_writable

    if output is None or output == STANDARD_OUTPUT:
        return
    why_not = why_not_writable(Path(output))
    if why_not:
        raise click.UsageError(f"--json {output} cannot be written: {why_not}")
    if real_path(output) in {real_path(capture) for capture in captures}:
        raise click.UsageError(f"--json {output} would overwrite a capture: name another file")
