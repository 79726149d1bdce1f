"""`bilprov report` and `bilprov recheck`: shows, compares and judges again what runs have left."""

from __future__ import annotations

import click
import msgspec
from msgspec import structs

from bilprov.analyzer.cli.command import argument, command, flag, protocol_in_use, typed_protocol
from bilprov.analyzer.cli.command_files import STANDARD_OUTPUT
from bilprov.analyzer.cli.options import note
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.captures.errors import CaptureError
from bilprov.captures.text import printable, quantity
from bilprov.conformance.cli.outputs import SEVERAL, Outputs, outputs_option, write_each
from bilprov.conformance.recheck import Recheck
from bilprov.conformance.recheck import recheck as judged_again
from bilprov.conformance.report.json_report import ReportError, as_json, read_report
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
    outputs, verbose = Outputs(options.outputs), options.verbose
    outputs.require_writable(options.results)
    try:
        reports = [
            structs.replace(read_report(path), file=one_line(path)) for path in options.results
        ]
    except ReportError as error:
        raise click.UsageError(str(error)) from error
    protocol = protocol_in_use()
    write_each((output.path, output.write(reports, protocol)) for output in outputs)
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


# -- recheck --------------------------------------------------------------------------------------


class RecheckOptions(msgspec.Struct, frozen=True):
    """The options of `recheck`."""

    path: str = argument(metavar="FILE.mcap")
    outputs: dict[str, str] = outputs_option(
        ["json"], "The new report as JSON; - is standard output."
    )


@command(RecheckOptions)
def recheck(options: RecheckOptions) -> int:
    """Examples:
      bilprov recheck run.mcap

    Nothing but the bytes and the observations of the probe is used. Every byte of FILE.mcap is
    checked against its hash and its checksums first. Then the cases are judged again by the grammar
    that the file carries (or bilprov --grammar FILE.py), and each case is listed whose verdict, in
    all or on one axis, differs from the recorded one. A hash reveals damage, not forgery.

    Exit code: 0 the same, 1 something differs, 2 the file is damaged or cannot be judged again, or
    there is no report for --json because the run strayed from its recording, 3 the same as far as
    it could be judged again: the recording was never finished, or another version of bilprov made
    it with cases that this one no longer makes.
    """
    promise_verdict()
    path, outputs = options.path, Outputs(options.outputs)
    outputs.require_writable([path])
    to_stdout = outputs.onto_stdout
    found = judged_again(path, typed_protocol())
    try:
        if found.report is not None:
            text = as_json(found.report).decode()
            write_each((output.path, text) for output in outputs)
    finally:
        for sentence in found.notes:
            note(sentence)
        for difference in found.differences:
            recorded, judged = printable(difference.recorded), printable(difference.judged)
            words = f"{difference.what} recorded: {recorded}; judged again: {judged}"
            click.echo(f"{difference.about}: {words}", err=to_stdout)
        click.echo(_sum(found), err=to_stdout)
    if outputs and found.report is None:
        raise CaptureError(f"{path} has no new report to write: the run strayed from its recording")
    return found.exit


def _sum(found: Recheck) -> str:
    if found.differences:
        more = len(found.differences)
        return f"not the same: {more} {'difference' if more == 1 else 'differences'}"
    far = "" if found.whole else ", as far as it could be judged again"
    return f"the same: {quantity(found.cases, 'case')}, verdict {found.verdict}{far}"
