"""`bilprov report`: reads reports of runs back, and writes them as pages or shows them here."""

from __future__ import annotations

import click
import msgspec
from msgspec import structs

from bilprov.analyzer.cli.command import argument, command, flag, protocol_in_use
from bilprov.analyzer.cli.command_files import STANDARD_OUTPUT
from bilprov.analyzer.cli.options import note
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.conformance.cli.outputs import (
    SEVERAL,
    deliver,
    outputs_of,
    outputs_option,
    require_writable,
)
from bilprov.conformance.report.json_report import ReportError, read_report
from bilprov.spec.errors import one_line


class ReportOptions(msgspec.Struct, frozen=True):
    """The options of `report`."""

    results: tuple[str, ...] = argument(nargs=-1, required=True, metavar="A.json [B.json ...]")
    outputs: dict[str, str] = outputs_option(SEVERAL)
    verbose: bool = flag("List every case that differs or did not pass.", "-v", "--verbose")


@command(ReportOptions)
def report(options: ReportOptions) -> int:
    """Examples:
      bilprov report run.json
      bilprov report monday.json tuesday.json --html week.html

    Pages are written with several runs side by side. Without --html, --junit or --markdown a table
    is shown here. Exit code: 0 once it is written, whatever the verdicts are.
    """
    promise_verdict()
    outputs, verbose = outputs_of(options.outputs), options.verbose
    require_writable(outputs, inputs=options.results)
    try:
        reports = [
            structs.replace(read_report(path), file=one_line(path)) for path in options.results
        ]
    except ReportError as error:
        raise click.UsageError(str(error)) from error
    protocol = protocol_in_use()
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
