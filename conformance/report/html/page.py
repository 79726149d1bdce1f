"""Writes reports as one self-contained HTML page, which loads nothing from elsewhere.

It begins with the causes: what to change, each with the line that shows it and what then passed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from bilprov.analyzer.html.markup import Safe, joined, json_block, tag
from bilprov.analyzer.html.page import html_page
from bilprov.captures.text import quantity
from bilprov.conformance.oracle.verdicts import Cause, Verdict, WireEvent
from bilprov.conformance.report.conclusion import EXIT_VERDICTS, conclusion
from bilprov.conformance.report.grouping import Row, names, rows, tally
from bilprov.conformance.report.html.cases import WireWords, case_data, case_rows, matrix
from bilprov.conformance.report.html.facts import coverage, facts, profile
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol

_PAGE = Path(__file__).parent / "assets"


def as_html(reports: Sequence[Report], protocol: Protocol) -> str:
    """One page about one report, or about several side by side.

    Bytes are described in the words of `protocol`, in reports that were made with this grammar.
    """
    style = (_PAGE / "report.css").read_text(encoding="utf-8")
    script = (_PAGE / "report.js").read_text(encoding="utf-8")
    told, cases = names(reports), rows(reports)
    body = joined(
        [
            _header(reports, told),
            tag("main", joined(_sections(reports, told, cases, protocol))),
            json_block("data", case_data(reports, told, cases, protocol)),
        ]
    )
    title = f"{', '.join(told)} · bilprov conformance report"
    return html_page(title, body, style=style, script=script)


def _header(reports: Sequence[Report], told: Sequence[str]) -> Safe:
    several = len(reports) > 1
    verdicts = [
        tag(
            "p",
            tag("span", name, class_="device") if several else "",
            conclusion(report).plain,
            class_=f"conclusion v-{EXIT_VERDICTS[report.exit].label}",
        )
        for name, report in zip(told, reports, strict=True)
    ]
    title = f"{len(reports)} runs side by side" if several else tag("span", *told, class_="device")
    failed = ("Causes",) if any(report.causes for report in reports) else ()
    links = (*failed, "Matrix", "Cases", "Profile", "Coverage")
    return tag(
        "header",
        tag("p", "bilprov", tag("span", " conformance report"), class_="brand"),
        tag("h1", "" if several else "Conformance of ", title),
        *verdicts,
        tag("nav", *(tag("a", word, href=f"#{word.lower()}") for word in links), aria_label="Page"),
    )


def _sections(
    reports: Sequence[Report], told: list[str], cases: list[Row], protocol: Protocol
) -> Iterator[Safe]:
    yield from causes(reports, told, protocol)
    yield tag(
        "section",
        tag("h2", "Matrix by clause"),
        matrix(told, cases) if cases else tag("p", "No case was judged.", class_="dim"),
        id="matrix",
    )
    yield tag(
        "section",
        tag("h2", "Cases"),
        tag("noscript", tag("p", "Wire logs and filters need JavaScript; this list does not.")),
        _filters(reports, cases),
        tag("p", "", id="shown", aria_live="polite", class_="dim"),
        _columns(told) if len(told) > 1 else Safe(""),
        tag("div", case_rows(cases), id="list", class_=f"runs-{min(len(told), 6)}"),
        id="cases",
    )
    yield tag("section", tag("h2", "Profile"), profile(reports, told), id="profile")
    yield tag("section", tag("h2", "Coverage"), coverage(reports, told), id="coverage")
    yield facts(reports, told)


def _columns(told: list[str]) -> Safe:
    """A numbered list that says which column of the list of cases is which report."""
    entries = [tag("li", tag("b", index), " ", name) for index, name in enumerate(told, 1)]
    return tag("ol", *entries, class_="columns")


def _filters(reports: Sequence[Report], cases: list[Row]) -> Safe:
    """Buttons for the verdicts and a text field; hidden until the script, which they need, runs."""
    counts = tally(result for row in cases for result in row.results)
    per: list[tuple[str, str, int]] = [
        (verdict.label, verdict.label, sum(verdict in _verdicts(row) for row in cases))
        for verdict in counts
    ]
    if len(reports) > 1:
        per.append(("missing", "not in all", sum(None in row.results for row in cases)))
        per.append(("differs", "differing", sum(row.differs for row in cases)))
    per = [entry for entry in per if entry[2]]
    chips = [
        tag(
            "button",
            tag("span", word, class_="word"),
            tag("span", f"{count:,}", class_="count"),
            type="button",
            class_=f"chip v-{name}",
            data_v=name,
            aria_pressed="false",
        )
        for name, word, count in per
    ]
    search = tag(
        "label",
        tag("span", "Search ", class_="unseen"),
        Safe('<input id="search" type="search" placeholder="Search id, clause, reason">'),
    )
    everything = tag("button", "Show all", type="button", id="everything", class_="chip")
    scope = tag("button", "", type="button", id="scope", class_="chip", hidden=True)
    return tag(
        "div", *chips, scope, everything, search, id="filters", hidden=True, role="group",
        aria_label="Filter the cases",
    )  # fmt: skip


def _verdicts(row: Row) -> set[Verdict]:
    return {result.verdict for result in row.results if result}


_SIGNS = {"sent": "→", "received": "←", "look": "◉", "clipped": "…"}


def causes(reports: Sequence[Report], told: Sequence[str], protocol: Protocol) -> Iterator[Safe]:
    """Yield a section with the causes of each run that has some."""
    for report, name in zip(reports, told, strict=True):
        if not report.causes:
            continue
        words = WireWords(protocol, report)
        title = "Causes" if len(reports) == 1 else f"Causes: {name}"
        left = report.unexplained
        yield tag(
            "section",
            tag("h2", title),
            tag("ol", *(_cause(report, cause, words) for cause in report.causes)),
            tag("p", f"{quantity(left, 'failed case')} of no cause found", class_="dim")
            if left
            else "",
            id="causes",
            class_="causes",
        )


def _cause(report: Report, cause: Cause, words: WireWords) -> Safe:
    links = (
        tag("a", ident, href=f"#case={ident}", class_="id", title="the case")
        for ident in cause.cases
    )
    return tag(
        "li",
        tag("p", cause.sentence, " ", tag("span", cause.clause, class_="dim"), class_="what"),
        tag(
            "p",
            tag("code", report.send_line(cause)),
            tag("button", "Copy", type="button", class_="chip"),
            class_="again",
        ),
        _wire(cause.log, words) if cause.log else "",
        tag("details", tag("summary", quantity(len(cause.cases), "case")), tag("p", *links)),
        class_="cause",
    )


def _wire(log: Sequence[WireEvent], words: WireWords) -> Safe:
    rows = (
        tag(
            "tr",
            tag("td", f"{event.t * 1e3:.1f} ms", class_="number"),
            tag("td", _SIGNS[event.kind]),
            tag("td", event.hex, class_="hex"),
            tag("td", meaning),
        )
        for event, meaning in zip(log, words.of(log), strict=True)
    )
    return tag("table", tag("tbody", *rows), class_="wire")
