"""Shows a report: a table of classes and verdicts, then each case that did not pass."""

from __future__ import annotations

from collections import Counter

from rich.console import Console
from rich.table import Table
from rich.text import Text

from conformance.report import Report, reproduce
from conformance.verdicts import CaseResult, Verdict

STYLES = {
    Verdict.PASS: "green",
    Verdict.INFORMATIONAL: "cyan",
    Verdict.NON_STRICT: "yellow",
    Verdict.INCONCLUSIVE: "magenta",
    Verdict.FAIL: "bold red",
    Verdict.ERROR: "bold white on red",
    Verdict.SKIPPED: "dim",
}
_SHOWN = 2  # cases of each class and verdict, unless all are asked for
_REASONS = 8


def show(report: Report, console: Console, *, everything: bool = False) -> None:
    """Print the summary; `everything` lists every case that did not pass."""
    if report.results:
        console.print(_table(report))
    for verdict in (Verdict.ERROR, Verdict.FAIL, Verdict.INCONCLUSIVE, Verdict.NON_STRICT):
        found = [result for result in report.results if result.verdict is verdict]
        if verdict is Verdict.INCONCLUSIVE and not everything:
            _reasons(found, console)
        else:
            _cases(report, found, console, len(found) if everything else _SHOWN)
    for name, (done, of) in report.coverage.items():
        if report.results and done:
            console.print(Text(f"{name}: {done} of {of}", "dim"))
    timeout = report.profile.get("truncation_timeout_ms")
    latency = report.profile.get("latency_median_ms")
    if timeout is not None:
        console.print(Text(f"measured truncation time-out: {timeout} ms", "dim"))
    if latency is not None and report.link["kind"] == "port":
        slowest = report.profile.get("latency_max_ms")
        console.print(Text(f"answers after {latency} ms (median), {slowest} ms (longest)", "dim"))
    console.print(Text(f"seed {report.seed}", "dim"))
    console.print(conclusion(report))


def conclusion(report: Report) -> Text:
    """The one line that says how it ended."""
    if report.unusable:
        return Text(f"not judged: {report.unusable}", STYLES[Verdict.ERROR])
    counts = {name: count for name, count in report.counts.items() if count}
    words = ", ".join(f"{count} {name}" for name, count in counts.items())
    if report.exit == 0:
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


def _table(report: Report) -> Table:
    columns = [v for v in Verdict if any(r.verdict is v for r in report.results)]
    table = Table(title=f"{report.device}, {report.grammar['name']} {report.grammar['version']}")
    table.add_column("cases")
    for verdict in columns:
        table.add_column(verdict.label, justify="right", style=STYLES[verdict])
    groups: dict[str, Counter[Verdict]] = {}
    for result in report.results:
        groups.setdefault(result.id.split("/")[0], Counter())[result.verdict] += 1
    for name, counts in groups.items():
        table.add_row(name, *(str(counts[v] or "") for v in columns))
    if len(groups) > 1:
        total = Counter(result.verdict for result in report.results)
        table.add_section()
        table.add_row("all", *(str(total[v]) for v in columns))
    return table


def _reasons(found: list[CaseResult], console: Console) -> None:
    """What could not be judged, by reason: it is rarely about the single case."""
    counts = Counter(result.reason for result in found)
    for reason, count in counts.most_common(_REASONS):
        cases = "1 case" if count == 1 else f"{count} cases"
        first = next(result.id for result in found if result.reason == reason)
        line = Text(f"inconclusive {cases}", STYLES[Verdict.INCONCLUSIVE])
        console.print(line.append(f" ({first} is the first): {reason}", "default"))


def _cases(report: Report, found: list[CaseResult], console: Console, most: int) -> None:
    """The first `most` cases of each class in full, the others counted."""
    classes: dict[str, list[CaseResult]] = {}
    for result in found:
        classes.setdefault(result.id.split("/")[0], []).append(result)
    for name, results in classes.items():
        for result in results[:most]:
            _case(result, console)
        left = len(results) - most
        if left > 0:
            more = f"      and {left} more of {name}; --verbose lists them"
            console.print(Text(more, "dim"))
    if found and found[0].verdict is Verdict.FAIL:
        console.print(Text(f"again: {reproduce(report, found[0].id)}"))


def _case(result: CaseResult, console: Console) -> None:
    """One case: what was sent, and for each axis that is not well what was expected and seen."""
    head = Text.assemble(
        (result.verdict.label, STYLES[result.verdict]),
        " ",
        (result.id, "bold"),
        (f"  {result.clause}", "dim"),
    )
    console.print(head)
    rows = [("", result.requirement), ("sent", " | ".join(result.sent) or "nothing")]
    for name, axis in result.axes.items():
        if axis.verdict in (Verdict.PASS, Verdict.SKIPPED):
            continue
        reading = f" [{axis.reading}]" if axis.reading else ""
        rows += [
            (name, axis.reason + reading),
            ("expected", axis.expected),
            ("got", axis.actual),
        ]
    for label, words in rows:
        if words:
            line = Text.assemble((f"      {label:10}" if label else "      ", "dim"), words)
            console.print(line)
