"""The causes on a page: what to mend, each with the line that shows it and what then passed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bilprov.analyzer.html.markup import Safe, tag
from bilprov.captures.text import quantity
from bilprov.conformance.oracle.verdicts import Cause, WireEvent
from bilprov.conformance.report.html.cases import WireWords
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol

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
