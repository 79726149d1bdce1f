"""The command `stats`: counts over whole captures, for people and as JSON and CSV."""

from __future__ import annotations

import click

from bilprov.analyzer.cli.options import compiled, filter_option, note
from bilprov.analyzer.cli.output_files import (
    STANDARD_OUTPUT,
    force_option,
    require_writable,
    write_output,
)
from bilprov.analyzer.cli.progress import reading
from bilprov.captures.text import escape_json


@click.command()
@click.argument("files", metavar="FILE.mcap...", nargs=-1, required=True)
@filter_option
@click.option(
    "--json",
    "json_file",
    metavar="FILE",
    help="Write everything as one JSON object; - is standard output, which then holds nothing "
    "else.",
)
@click.option(
    "--csv",
    "csv_file",
    metavar="FILE",
    help="Write everything as one CSV table (file, group, key, measure, value); - is standard "
    "output.",
)
@force_option
@click.pass_obj
def stats(
    grammar: str | None,
    files: tuple[str, ...],
    expression: str | None,
    json_file: str | None,
    csv_file: str | None,
    force: bool,
) -> None:
    """Count what captures hold: frames, answers, anomalies, latencies, load, time moving.

    Examples:
      bilprov stats drive.mcap
      bilprov stats monday.mcap tuesday.mcap --json week.json

    Each capture is decoded from its raw bytes, as replay does, and counted by itself; where there
    are several, all of them together too. The keys of the JSON are explained in
    analyzer/output/capture_stats.py, the CSV in stats_csv.py beside it. With --filter only what
    passes is counted, from the first such byte to the last.
    """
    import msgspec

    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.analyzer.output.capture_stats import file_stats, stats_of
    from bilprov.analyzer.output.charts import ASCII, BLOCKS
    from bilprov.analyzer.output.console import can_show, show
    from bilprov.analyzer.output.stats_csv import stats_csv
    from bilprov.analyzer.output.stats_tables import drawn
    from bilprov.analyzer.replay.capture_session import capture_line, said_about
    from bilprov.analyzer.replay.capture_totals import capture_totals
    from bilprov.analyzer.totals.totals import Totals
    from bilprov.captures.reader import open_capture

    named = {"--json": json_file, "--csv": csv_file}
    outputs = [(option, path) for option, path in named.items() if path is not None]
    require_writable(outputs, inputs=files, force=force)
    protocol = load_protocol(grammar)
    test = compiled(expression, protocol)
    captures = [open_capture(file) for file in files]
    for capture in captures:
        for sentence in said_about(capture, protocol):
            note(sentence)
    each, together = [], Totals(protocol)
    with reading(captures) as progress:
        for capture in captures:
            totals = capture_totals(
                capture,
                protocol,
                progress,
                test.started(capture.start) if test else None,
            )
            together.merge(totals)
            each.append(file_stats(capture, totals, capture_line(capture, protocol)))
    found = stats_of(protocol, each, together, expression)
    if json_file is not None:
        text = msgspec.json.format(msgspec.json.encode(found), indent=1) + b"\n"
        write_output(json_file, escape_json(text))
    if csv_file is not None:
        write_output(csv_file, stats_csv(found).encode())
    if STANDARD_OUTPUT not in named.values():
        show(*drawn(found, BLOCKS if can_show(BLOCKS.steps + BLOCKS.fills) else ASCII))
