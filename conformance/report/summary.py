"""Shows reports on a terminal: a table of case groups, then what did not pass or what differs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bilprov.captures.text import quantity
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.report import grouping
from bilprov.conformance.report.run_report import STYLES, Report, conclusion, evidence, run_facts

# The verdicts whose cases are listed, the first one's only if every case is asked for.
_LISTED = (
    Verdict.INFORMATIONAL,
    Verdict.NON_STRICT,
    Verdict.INCONCLUSIVE,
    Verdict.FAIL,
    Verdict.ERROR,
)
# Short enough for all columns on 80 columns; the first is TTCN-3's own word.
_HEADINGS = {Verdict.INCONCLUSIVE: "inconc", Verdict.INFORMATIONAL: "info"}
_UNBROKEN = 100_000  # columns
_SHOWN = 2  # cases of each class and verdict, unless all are asked for
_REASONS = 8
_DIFFERING = 20
_CHANGED = 6  # ids of cases with the same change


def summary_console(*, stderr: bool = False) -> Console:
    """A console for a summary: wrapped by words on a terminal, lines left whole elsewhere."""
    console = Console(stderr=stderr, highlight=False)
    if not console.is_terminal:
        console.width = _UNBROKEN
    return console


def show(
    report: Report, console: Console, *, everything: bool = False, brief: bool = False
) -> None:
    """Print the summary; `everything` lists every case that did not pass.

    A `brief` one has no table of groups, and not how the run was made.
    What matters most is printed last, where a terminal stays: the failures, then the conclusion.
    """
    if not report.unusable:
        if report.results and not brief:
            console.print(_table(report))
        for line in () if brief else _facts(report):
            console.print(Text(line, "dim"))
        for sentence in (*report.notices, *report.unseen):
            console.print(Text(sentence, STYLES[Verdict.INCONCLUSIVE]))
        if report.proof:
            console.print(Text(report.proof))
        _causes(report, console)
        _not_passed(report, console, everything=everything)
        for sentence in report.comparison.stale if report.comparison else ():
            console.print(Text(sentence, STYLES[Verdict.FAIL]))
    console.print(conclusion(report))


def _causes(report: Report, console: Console) -> None:
    """Print the causes of the failures, the worst first, each with the line that shows it."""
    for cause in report.causes:
        line = Text.assemble(("cause", STYLES[Verdict.FAIL]), " ", cause.sentence)
        console.print(line.append(f"  {cause.clause}", "dim"))
        more = f" and {len(cause.cases) - _SHOWN} more" if len(cause.cases) > _SHOWN else ""
        cases = f"{', '.join(cause.cases[:_SHOWN])}{more}"
        console.print(Text.assemble(("      cases     ", "dim"), cases))
        console.print(
            Text.assemble(("      again     ", "dim"), report.send_line(cause)), soft_wrap=True
        )
        if cause.shown:
            console.print(Text.assemble(("      shows     ", "dim"), cause.shown))
    if report.causes and report.unexplained:
        console.print(Text(f"no cause found for {quantity(report.unexplained, 'failed case')}"))


def _not_passed(report: Report, console: Console, *, everything: bool) -> None:
    """Print the cases that did not pass, the worst verdict last."""
    for verdict in _LISTED:
        found = [r for r in report.results if r.verdict is verdict and not r.expected_failure]
        if verdict is Verdict.FAIL and not everything:
            found = _without_causes(report, found, console)
        if verdict is Verdict.INFORMATIONAL and not everything:
            continue
        if verdict is Verdict.INCONCLUSIVE and not everything:
            _reasons(found, console)
        else:
            _cases(found, console, len(found) if everything else _SHOWN)


def _without_causes(report: Report, found: list[CaseResult], console: Console) -> list[CaseResult]:
    """The failed cases that no cause explains; of the others one line says how many they are."""
    explained = {ident for cause in report.causes for ident in cause.cases}
    left = [result for result in found if result.id not in explained]
    if len(left) < len(found):
        words = quantity(len(found) - len(left), "case")
        causes = "the cause" if len(report.causes) == 1 else "the causes"
        console.print(Text(f"fail {words}, explained by {causes} above; --verbose lists them"))
    return left


def _facts(report: Report) -> Iterator[str]:
    """Lines on coverage, what was measured, the device's choices, and how the run was made."""
    for name, covered in report.coverage.items():
        if covered.done:
            yield f"{name}: {covered.done} of {covered.of}"
    profile = report.profile
    timeout, latency = profile.truncation_timeout_ms, profile.latency_median_ms
    if timeout is not None:
        yield f"measured truncation time-out: {timeout} ms"
    if latency is not None and report.link.get("kind") == "port":
        yield f"answers after {latency} ms (median), {profile.latency_max_ms} ms (longest)"
    chosen = profile.other_readings
    if chosen:
        yield "other readings of the document: " + ", ".join(f"{p} {w}" for p, w in chosen.items())
    about = run_facts(msgspec.structs.replace(report, unseen=(), notices=()))
    if about:
        yield ", ".join(f"{name} {words}" for name, words in about.items())
    yield f"level {report.options.level}, seed {report.seed}"
    if report.comparison:
        yield f"{report.comparison.expected} fail as {report.comparison.file} expects"


def _table(report: Report) -> Table:
    total = grouping.tally(report.results)
    columns = list(reversed(total))
    title = f"{report.device}, {report.grammar.name} {report.grammar.version}"
    table = Table(title=Text(title, "table.title"))
    table.add_column("cases", no_wrap=True)
    for verdict in columns:
        heading = _HEADINGS.get(verdict, verdict.label)
        table.add_column(heading, justify="right", style=STYLES[verdict], no_wrap=True)
    groups = grouping.by_group(report.results)
    for name, results in groups.items():
        counts = grouping.tally(results)
        table.add_row(Text(name), *(str(counts.get(v, "")) for v in columns))
    if len(groups) > 1:
        table.add_section()
        table.add_row("all", *(str(total[v]) for v in columns))
    return table


def _reasons(found: list[CaseResult], console: Console) -> None:
    """The inconclusive cases by reason, because many cases often share one."""
    for cases, first, reason in grouping.by_reason(found)[:_REASONS]:
        line = Text(f"inconclusive {cases}", STYLES[Verdict.INCONCLUSIVE])
        console.print(line.append(f" ({first} is the first): {reason}", "default"))


def _cases(found: list[CaseResult], console: Console, most: int) -> None:
    """Print the first `most` cases of each group in full, and how many others there are."""
    for name, results in grouping.by_group(found).items():
        for result in results[:most]:
            _case(result, console)
        left = len(results) - most
        if left > 0:
            more = f"      and {left} more of {name}; --verbose lists them"
            console.print(Text(more, "dim"))
    if found and found[0].verdict is Verdict.FAIL:
        console.print(Text(f"again: {found[0].reproduce}"), soft_wrap=True)


def _case(result: CaseResult, console: Console) -> None:
    """Print one case: what was sent, and for each axis not passed what was expected and seen."""
    head = Text.assemble(
        (result.verdict.label, STYLES[result.verdict]),
        " ",
        (result.id, "bold"),
        (f"  {result.clause}", "dim"),
    )
    console.print(head)
    lines = [("", result.requirement), *evidence(result)]
    if result.sends:
        lines.append(("again", result.reproduce))
    for label, words in lines:
        line = Text.assemble((f"      {label:10}" if label else "      ", "dim"), words)
        # A terminal joins what it wrapped itself when the line is copied.
        console.print(line, soft_wrap=label in ("sent", "again"))


def show_compared(reports: Sequence[Report], console: Console, *, everything: bool = False) -> None:
    """Print one column for each report, and what changed from the first to the last.

    `everything` lists every case on which they differ.
    """
    told = grouping.names(reports)
    cases = grouping.rows(reports)
    console.print(_compared(told, cases))
    failing = grouping.changed_cases(cases)
    known = {ident for ids in failing.values() for ident in ids}
    differing = [row for row in cases if row.differs and row.id not in known]
    shown = differing if everything else differing[:_DIFFERING]
    for row in shown:
        line = Text.assemble((row.id, "bold"), "  ")
        for index, result in enumerate(row.results):
            line.append(", " if index else "").append(_word(result))
        console.print(line)
    if len(shown) < len(differing):
        left = len(differing) - len(shown)
        console.print(Text(f"and {left} more differ; --verbose lists them", "dim"))
    for change, ids in failing.items():
        _changed(change, ids, console, len(ids) if everything else _CHANGED)
    for change, cause, before in grouping.changed_causes(reports[0].causes, reports[-1].causes):
        console.print(Text.assemble((f"cause {change}", "bold"), f"  {cause.sentence}"))
        if before:
            console.print(Text.assemble(("      before    ", "dim"), before))
    for name, report in zip(told, reports, strict=True):
        fault = f", --fault {report.fault}" if report.fault else ""
        console.print(Text.assemble((f"{name}{fault}: ", "dim"), conclusion(report)))


def _changed(change: str, ids: Sequence[str], console: Console, most: int) -> None:
    """Print what became of some cases, and the first `most` of their ids."""
    left = len(ids) - most
    more = f" and {left} more; --verbose lists them" if left > 0 else ""
    head = (f"{change} {len(ids)}", "bold")
    console.print(Text.assemble(head, f"  {', '.join(ids[:most])}{more}"))


def _compared(told: Sequence[str], cases: Sequence[grouping.Row]) -> Table:
    table = Table()
    table.add_column("cases")
    for name in told:
        table.add_column(Text(name))
    groups = grouping.by_group(cases)
    for group, found in groups.items():
        table.add_row(Text(group), *(_cell(found, index) for index in range(len(told))))
    if len(groups) > 1:
        table.add_section()
        table.add_row("all", *(_cell(cases, index) for index in range(len(told))))
    return table


def _cell(found: Sequence[grouping.Row], index: int) -> Text:
    """One report's verdicts on some cases, the worst first."""
    results = [row.results[index] for row in found]
    parts = [
        Text(f"{count} {verdict.label}", STYLES[verdict])
        for verdict, count in grouping.tally(results).items()
    ]
    missing = results.count(None)
    if missing:
        parts.append(Text(f"{missing} not run", "dim"))
    return Text(", ").join(parts)


def _word(result: CaseResult | None) -> Text:
    return Text(result.verdict.label, STYLES[result.verdict]) if result else Text("not run", "dim")
