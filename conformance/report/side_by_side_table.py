"""Shows several reports side by side on a terminal: a table of groups, then what differs."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bilprov.conformance.oracle.verdicts import CaseResult
from bilprov.conformance.report.conclusion import STYLES, conclusion
from bilprov.conformance.report.grouping import by_group, tally
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.report.side_by_side import Row, names, rows

_SHOWN = 20


def show_compared(reports: Sequence[Report], console: Console, *, everything: bool = False) -> None:
    """Print one column for each report; `everything` lists every case on which they differ.

    Control characters in the reports must have been escaped before (`visible_report`).
    """
    told = names(reports)
    cases = rows(reports)
    console.print(_table(told, cases))
    differing = [row for row in cases if row.differs]
    shown = differing if everything else differing[:_SHOWN]
    for row in shown:
        line = Text.assemble((row.id, "bold"), "  ")
        for index, result in enumerate(row.results):
            line.append(", " if index else "").append(_word(result))
        console.print(line)
    if len(shown) < len(differing):
        left = len(differing) - len(shown)
        console.print(Text(f"and {left} more differ; --verbose lists them", "dim"))
    for name, report in zip(told, reports, strict=True):
        console.print(Text.assemble((f"{name}: ", "dim"), conclusion(report)))


def _table(told: Sequence[str], cases: Sequence[Row]) -> Table:
    table = Table()
    table.add_column("cases")
    for name in told:
        table.add_column(Text(name))
    groups = by_group(cases)
    for group, found in groups.items():
        table.add_row(Text(group), *(_cell(found, index) for index in range(len(told))))
    if len(groups) > 1:
        table.add_section()
        table.add_row("all", *(_cell(cases, index) for index in range(len(told))))
    return table


def _cell(found: Sequence[Row], index: int) -> Text:
    """One report's verdicts on some cases, the worst first."""
    results = [row.results[index] for row in found]
    parts = [
        Text(f"{count} {verdict.label}", STYLES[verdict])
        for verdict, count in tally(results).items()
    ]
    missing = results.count(None)
    if missing:
        parts.append(Text(f"{missing} not run", "dim"))
    return Text(", ").join(parts)


def _word(result: CaseResult | None) -> Text:
    return Text(result.verdict.label, STYLES[result.verdict]) if result else Text("not run", "dim")
