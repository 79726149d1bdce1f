"""`bilprov report`: reads reports of runs back, and writes them as pages or shows them here."""

from __future__ import annotations

import click
from msgspec import structs

from bilprov.analyzer.cli.options import note
from bilprov.analyzer.cli.output_files import STANDARD_OUTPUT
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.conformance.cli.outputs import (
    Output,
    deliver,
    output_options,
    require_writable,
)
from bilprov.conformance.report.formats import SEVERAL
from bilprov.conformance.report.json_report import ReportError, read_report
from bilprov.spec.errors import one_line

*_FIRST, _LAST = sorted(f"--{name}" for name in SEVERAL)
_HELP = f"""Write pages from what conform --json wrote, several runs side by side.

Examples:
  bilprov report run.json
  bilprov report monday.json tuesday.json --html week.html

Without {", ".join(_FIRST)} or {_LAST} a table is shown here. Exit code: 0 once it is written,
whatever the verdicts are.
"""


@click.command(help=_HELP)
@click.argument("results", nargs=-1, required=True, metavar="A.json [B.json ...]")
@output_options(SEVERAL)
@click.option("-v", "--verbose", is_flag=True, help="List every case that differs or did not pass.")
@click.pass_obj
def report(
    grammar: str | None,
    results: tuple[str, ...],
    outputs: list[Output],
    verbose: bool,
) -> int:
    """Write reports that are read from files in other formats, or show them."""
    promise_verdict()
    require_writable(outputs, inputs=results)
    try:
        reports = [structs.replace(read_report(path), file=one_line(path)) for path in results]
    except ReportError as error:
        raise click.UsageError(str(error)) from error
    protocol = load_protocol(grammar)
    deliver(outputs, reports, protocol)
    if not outputs:
        from bilprov.conformance.report.summary import show, show_compared, summary_console

        console = summary_console()
        if len(reports) == 1:
            show(reports[0], console, everything=verbose)
        else:
            show_compared(reports, console, everything=verbose)
    for output in outputs:
        if output.path != STANDARD_OUTPUT:
            note(f"{output.path} written")
    return 0
