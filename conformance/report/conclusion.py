"""The conclusion of a run in one line, for every format of the report."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from bilprov.captures.text import quantity
from bilprov.conformance.oracle.sight import NOT_OBSERVABLE
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
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
    words = _counts(report)
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


def _counts(report: Report) -> str:
    """How many cases have each verdict; without a probe, what was not seen and what was right."""
    counts = Counter(result.verdict for result in report.results)
    told = []
    if report.link.get("probe") == "none" and counts[Verdict.INCONCLUSIVE]:
        unseen = Counter(filter(None, map(_unseen, report.results)))
        if unseen:
            what = " and ".join(quantity(count, axis) for axis, count in unseen.most_common())
            told = [f"{what} not seen without a probe"]
            counts[Verdict.INCONCLUSIVE] -= unseen.total()
            if right := counts.pop(Verdict.PASS, 0):
                told.append(f"{quantity(right, 'answer')} right")
    return ", ".join(told + [f"{counts[v]} {v.label}" for v in Verdict if counts[v]])


def _unseen(result: CaseResult) -> str:
    """The axis of an inconclusive case that no probe has seen, "" if there are other reasons."""
    if result.verdict is not Verdict.INCONCLUSIVE:
        return ""
    left = {n: axis for n, axis in result.axes.items() if axis.verdict is Verdict.INCONCLUSIVE}
    seen = any(not axis.reason.startswith(NOT_OBSERVABLE) for axis in left.values())
    return "" if seen else next(iter(left), "")
