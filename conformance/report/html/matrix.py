"""The matrix of a page: a table of clauses and their groups of cases, by verdict or by report."""

from __future__ import annotations

from collections.abc import Sequence

from bilprov.analyzer.html.markup import Safe, bar, joined, tag
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.report.grouping import Row, by_group, tally

_BAR = 160  # units of a bar's width


def matrix(told: Sequence[str], cases: Sequence[Row]) -> Safe:
    """A row for each clause and, below it, one for each group of its cases.

    About one report the columns are verdicts, about several they are the reports. Each number
    leads to its cases: `data-c`, `data-g` and `data-v` say which those are.
    """
    clauses: dict[str, list[Row]] = {}
    for row in cases:
        clauses.setdefault(row.clause, []).append(row)
    columns = list(tally(result for row in cases for result in row.results))  # the worst first
    several = len(told) > 1
    titles = (
        [tag("th", name, scope="col", class_="run") for name in told]
        if several
        else [tag("th", v.label, scope="col", class_="number") for v in columns]
        + [tag("th", "share", scope="col", class_="share")]
    )
    head = tag("thead", tag("tr", tag("th", "clause and cases", scope="col"), *titles))
    bodies = []
    for clause, its in clauses.items():
        lines = [_line(clause, clause, "", its, columns, several, "clause")]
        lines += [
            _line(name, clause, name, found, columns, several, "group")
            for name, found in by_group(its).items()
        ]
        bodies.append(tag("tbody", *lines))
    foot = tag("tfoot", _line("all cases", "", "", cases, columns, several, "all"))
    return tag("div", tag("table", head, *bodies, foot, class_="matrix"), class_="scroll")


def _line(
    name: str,
    clause: str,
    group: str,
    found: Sequence[Row],
    columns: Sequence[Verdict],
    several: bool,
    look: str,
) -> Safe:
    def link(words: object, verdict: str, css: str = "") -> Safe:
        where = {"data_c": clause, "data_g": group, "data_v": verdict}
        return tag("a", words, href="#cases", **where, class_=css or None)

    count = f"{len(found):,}"
    head = tag(
        "th", link(name, ""), " ", tag("span", count, class_="dim size"), scope="row", class_=look
    )
    if several:
        cells = [
            tag("td", _tallied([row.results[index] for row in found], link), class_="run")
            for index in range(len(found[0].results))
        ]
        return tag("tr", head, *cells)
    counts = tally([row.results[0] for row in found])
    cells = [
        tag(
            "td",
            link(f"{counts[v]:,}", v.label, f"n v-{v.label}") if v in counts else "",
            class_="number",
        )
        for v in columns
    ]
    return tag("tr", head, *cells, tag("td", _share(counts), class_="share"))


def _tallied(results: Sequence[CaseResult | None], link: object) -> Safe:
    """One report's verdicts on some cases, the worst first."""
    assert callable(link)
    counts = tally(results)
    parts = [link(f"{n:,} {v.label}", v.label, f"badge v-{v.label}") for v, n in counts.items()]
    missing = sum(result is None for result in results)
    if missing:
        parts.append(link(f"{missing:,} not run", "missing", "badge v-missing"))
    return joined(parts)


def _share(counts: dict[Verdict, int]) -> Safe:
    """The share of each verdict as a strip; the numbers beside it say the same."""
    total = sum(counts.values())
    x, parts = 0.0, []
    for verdict in sorted(counts):
        # Even a small share must be visible.
        width = max(counts[verdict] / total * _BAR, 3.0)
        parts.append((x, width, verdict.label))
        x += width
    scale = _BAR / x if x else 1.0
    return bar(_BAR, [(f"{at * scale:.2f}", f"{w * scale:.2f}", name) for at, w, name in parts])
