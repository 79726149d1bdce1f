"""Writes reports as short Markdown for a CI's page; text from a device cannot act as markup."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from bilprov.captures.text import quantity
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.report.grouping import by_group, by_reason, tally
from bilprov.conformance.report.run_report import EXIT_VERDICTS, Report, conclusion, run_facts
from bilprov.spec.protocol import Protocol

_FIRST = 10  # cases of each verdict in full
_REASONS = 8
_LONGEST = 400  # characters of one foreign text
_SIGNS = {
    Verdict.SKIPPED: "➖",
    Verdict.PASS: "✅",
    Verdict.INFORMATIONAL: "ℹ️",
    Verdict.NON_STRICT: "🟡",
    Verdict.INCONCLUSIVE: "❔",
    Verdict.FAIL: "❌",
    Verdict.ERROR: "💥",
}


def as_markdown(reports: Sequence[Report], protocol: Protocol) -> str:
    """Markdown: verdict, table of case groups, the first cases that did not pass, coverage."""
    return "\n".join("".join(f"{block}\n\n" for block in _report(one)) for one in reports)


def prose(text: str) -> str:
    """Foreign text as plain words: escaped so that it is no markup, HTML, link or @mention."""
    text = _clipped(text).strip()
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    text = re.sub(r"([\\`*_\[\]#|~$])", r"\\\1", text)
    # At the beginning of a text these make it a list or a heading.
    text = re.sub(r"^(\d+(?=[.)](?:\s|$))|(?=[-+=]))", r"\1\\", text)
    # GitHub makes links of addresses and of names; an empty comment keeps it from both.
    return re.sub(r"(?i)(@|://|\bwww(?=\.))", r"\1<!-- -->", text)


def code(text: str) -> str:
    """Foreign text as a span of code, fit for a table cell."""
    text = _clipped(text)
    fence = "`" * (1 + max((len(run) for run in re.findall("`+", text)), default=0))
    space = " " if text.startswith("`") or text.endswith("`") or not text.strip() else ""
    return f"{fence}{space}{text}{space}{fence}".replace("|", "\\|")


def _block(text: str) -> str:
    """Foreign text as a block of code."""
    text = _clipped(text)
    fence = "`" * max(3, 1 + max((len(run) for run in re.findall("`+", text)), default=0))
    return f"{fence}sh\n{text}\n{fence}"


def _clipped(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} …"


def _report(report: Report) -> Iterator[str]:
    """The blocks of one report; a blank line follows each."""
    yield f"## {_SIGNS[EXIT_VERDICTS[report.exit]]} {prose(conclusion(report).plain)}"
    grammar = report.grammar
    facts = [f"{prose(grammar.name)} {prose(grammar.version)}", f"seed {report.seed}"]
    facts += [f"probe {code(str(report.link['probe']))}"] if report.link.get("probe") else []
    yield f"{', '.join(facts)}, bilprov {prose(report.kit)}"
    about = run_facts(report)
    if about:
        yield ", ".join(f"{prose(name)} {code(words)}" for name, words in about.items())
    yield from _causes(report)
    if report.results:
        yield "\n".join(_table(report))
    if report.proof:
        yield " ".join(map(prose, re.split(r"(?<=\.) ", report.proof)))
    for verdict in (Verdict.ERROR, Verdict.FAIL, Verdict.NON_STRICT):
        found = [result for result in report.results if result.verdict is verdict]
        if found:
            yield from _cases(verdict, found)
    yield from _reasons([r for r in report.results if r.verdict is Verdict.INCONCLUSIVE])
    covered = [(name, covered) for name, covered in report.coverage.items() if covered.of]
    if report.results and covered:
        yield "### Coverage"
        yield "\n".join(f"- {prose(name)}: {c.done} of {c.of}" for name, c in covered)


def _causes(report: Report) -> Iterator[str]:
    """The causes of what failed, the worst first, each with the line that shows it."""
    if report.causes:
        yield "### Causes"
    for number, cause in enumerate(report.causes[:_FIRST], 1):
        yield f"{number}. {prose(cause.sentence)}, {prose(cause.clause)}"
        yield _block(report.send_line(cause))
        if cause.shown:
            yield f"It shows: {prose(cause.shown)}."
    if len(report.causes) > _FIRST:
        yield f"and {len(report.causes) - _FIRST} more causes."
    if report.causes and report.unexplained:
        yield f"No cause found for {quantity(report.unexplained, 'failed case')}."


def _table(report: Report) -> Iterator[str]:
    total = tally(report.results)
    columns = list(reversed(total))
    yield f"| cases | {' | '.join(f'{_SIGNS[v]} {v.label}' for v in columns)} |"
    yield f"|---|{'--:|' * len(columns)}"
    for name, results in by_group(report.results).items():
        counts = tally(results)
        yield f"| {code(name)} | {' | '.join(str(counts.get(v, '')) for v in columns)} |"
    yield f"| **all** | {' | '.join(f'**{total[v]}**' for v in columns)} |"


def _cases(verdict: Verdict, found: list[CaseResult]) -> Iterator[str]:
    yield f"### {_SIGNS[verdict]} {len(found)} {verdict.label}"
    for result in found[:_FIRST]:
        reading = f" ({prose(result.reading)})" if result.reading else ""
        yield f"**{code(result.id)}** {prose(result.clause)}: {prose(result.reason)}{reading}"
        yield f"Required: {prose(result.requirement)}"
        yield _block(result.reproduce)
    if len(found) > _FIRST:
        yield f"and {len(found) - _FIRST} more."


def _reasons(found: list[CaseResult]) -> Iterator[str]:
    """The inconclusive cases by reason, because many cases often share one."""
    if found:
        yield f"### {_SIGNS[Verdict.INCONCLUSIVE]} {len(found)} not judged"
        reasons = by_reason(found)
        lines = [
            f"- {cases}, {code(first)} is the first: {prose(reason)}"
            for cases, first, reason in reasons[:_REASONS]
        ]
        more = len(reasons) - _REASONS
        yield "\n".join([*lines, f"- and {more} more reasons"] if more > 0 else lines)
