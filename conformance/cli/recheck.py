"""`bilprov recheck`: a recorded run judged again."""

from __future__ import annotations

from pathlib import Path

import rich_click as click

from analyzer.grammar_file import load_protocol
from analyzer.options import note
from captures.errors import shown
from conformance.recheck import Difference, Recheck
from conformance.recheck import recheck as judged_again
from conformance.report.run_report import as_json


@click.command()
@click.argument("path", metavar="FILE.mcap")
@click.option(
    "--json", "json_path", metavar="FILE", help="The new report as JSON; - is standard output."
)
@click.pass_obj
def recheck(grammar: str | None, path: str, json_path: str | None) -> int:
    """Judge a recorded run again, from its bytes and looks alone.

    Every byte of FILE.mcap is checked against its hash and its checksums first. Then the cases are
    judged again by the grammar that the file carries (or bilprov --grammar FILE.py), and every case
    that comes out otherwise than recorded is named. A hash tells damage, not forgery.

    Exit code: 0 the same, 1 something differs, 2 the file is damaged or cannot be judged again, 3
    the same as far as a recording goes that was never finished.
    """
    if json_path not in (None, "-") and not Path(str(json_path)).absolute().parent.is_dir():
        raise click.UsageError(
            f"--json {json_path} cannot be written: name a file in a folder that exists"
        )
    found = judged_again(path, load_protocol(grammar) if grammar else None)
    for sentence in found.notes:
        note(sentence)
    for difference in found.differences:
        click.echo(_line(difference), err=json_path == "-")
    click.echo(_sum(found), err=json_path == "-")
    if json_path is not None and found.report is not None:
        report = as_json(found.report)
        if json_path == "-":
            click.echo(report, nl=False)
        else:
            Path(json_path).write_bytes(report)
    return found.exit


def _line(difference: Difference) -> str:
    return (
        f"{shown(difference.about)}: {difference.what} recorded: {shown(difference.recorded)}; "
        f"judged again: {shown(difference.judged)}"
    )


def _sum(found: Recheck) -> str:
    if found.differences:
        more = len(found.differences)
        return f"not the same: {more} {'difference' if more == 1 else 'differences'}"
    far = "" if found.whole else ", as far as the recording goes"
    return f"the same: {found.cases} cases, verdict {found.verdict}{far}"
