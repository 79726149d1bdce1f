"""`bilprov recheck`: judges a recorded run again, and lists the differences."""

from __future__ import annotations

import click
import msgspec

from bilprov.analyzer.cli.command import argument, command, typed_protocol
from bilprov.analyzer.cli.options import note
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.captures.errors import CaptureError
from bilprov.captures.text import printable, quantity
from bilprov.conformance.cli.outputs import (
    onto_standard_output,
    outputs_of,
    outputs_option,
    require_writable,
    write_each,
)
from bilprov.conformance.recheck import Difference, Recheck
from bilprov.conformance.recheck import recheck as judged_again
from bilprov.conformance.report.json_report import as_json


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
    path, outputs = options.path, outputs_of(options.outputs)
    require_writable(outputs, inputs=[path])
    to_stdout = onto_standard_output(outputs)
    found = judged_again(path, typed_protocol())
    try:
        if found.report is not None:
            text = as_json(found.report).decode()
            write_each((output.path, text) for output in outputs)
    finally:
        for sentence in found.notes:
            note(sentence)
        for difference in found.differences:
            click.echo(_line(difference), err=to_stdout)
        click.echo(_sum(found), err=to_stdout)
    if outputs and found.report is None:
        raise CaptureError(f"{path} has no new report to write: the run strayed from its recording")
    return found.exit


def _line(difference: Difference) -> str:
    return (
        f"{difference.about}: {difference.what} recorded: "
        f"{printable(difference.recorded)}; judged again: {printable(difference.judged)}"
    )


def _sum(found: Recheck) -> str:
    if found.differences:
        more = len(found.differences)
        return f"not the same: {more} {'difference' if more == 1 else 'differences'}"
    far = "" if found.whole else ", as far as it could be judged again"
    return f"the same: {quantity(found.cases, 'case')}, verdict {found.verdict}{far}"
