"""The conclusion of a run in one line, for every format of the report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.run_report import Report

if TYPE_CHECKING:
    from rich.text import Text

STYLES = {
    Verdict.PASS: "green",
    Verdict.INFORMATIONAL: "cyan",
    Verdict.NON_STRICT: "yellow",
    Verdict.INCONCLUSIVE: "magenta",
    Verdict.FAIL: "bold red",
    Verdict.ERROR: "bold white on red",
    Verdict.SKIPPED: "dim",
}

# The verdict whose sign or colour stands for an exit code.
EXIT_VERDICTS = {0: Verdict.PASS, 1: Verdict.FAIL, 2: Verdict.ERROR, 3: Verdict.INCONCLUSIVE}


def conclusion(report: Report) -> Text:
    """The line that says how the run ended, in the colour of its verdict."""
    from rich.text import Text

    if report.unusable:
        return Text(f"not judged: {report.unusable}", STYLES[Verdict.ERROR])
    counts = {name: count for name, count in report.counts.items() if count}
    words = ", ".join(f"{count} {name}" for name, count in counts.items())
    shard = report.options.get("shard")
    words += f" (shard {shard[0]} of {shard[1]})" if shard else ""
    comparison = report.comparison
    if comparison and comparison.expected and report.exit == 0:
        text = Text(f"{report.device} fails only as expected: {words}", STYLES[Verdict.PASS])
    elif comparison and comparison.stale and not comparison.unexpected:
        text = Text(f"{comparison.file} no longer fits: {words}", STYLES[Verdict.FAIL])
    elif report.exit == 0:
        text = Text(f"{report.device} conforms: {words}", STYLES[Verdict.PASS])
    elif report.exit == 1:
        text = Text(f"{report.device} does not conform: {words}", STYLES[Verdict.FAIL])
    else:
        text = Text(
            f"{report.device} was not judged in full: {words}", STYLES[Verdict.INCONCLUSIVE]
        )
    if report.ended:
        text.append(f" (ended early: {report.ended})")
    return text
