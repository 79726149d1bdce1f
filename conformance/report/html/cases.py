"""The cases of a page: their matrix, a list that needs no script, and the data drawn on a click.

The matrix is a table of clauses and their groups of cases, by verdict or by report. Every string
stands once in the data, in one table; the cases refer to it by number. Each entry of a wire log is
described in the grammar's words.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

from bilprov.analyzer.html.markup import Safe, bar, filled, joined, tag
from bilprov.captures.schemas import MS
from bilprov.conformance.oracle.judge import code_words
from bilprov.conformance.oracle.verdicts import AXES, CaseResult, Verdict, WireEvent
from bilprov.conformance.report.grouping import Row, by_group, tally
from bilprov.conformance.report.run_report import Report
from bilprov.spec.codec import judge
from bilprov.spec.framing import Framer
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import READINGS

_CASE = Path(__file__).parent / "assets" / "case.html"
_KINDS = {"sent": 0, "received": 1, "look": 2, "clipped": 3}


def case_rows(cases: Sequence[Row]) -> Safe:
    """One row for each case, closed; its details are drawn when it is opened."""
    return joined(_row(index, row) for index, row in enumerate(cases))


def _row(index: int, row: Row) -> Safe:
    worst = max((result for result in row.results if result), key=lambda r: r.verdict)
    words = worst.reason if worst.verdict is not Verdict.PASS else ""
    named = [
        (r.verdict.label, r.verdict.label) if r else ("missing", "not run") for r in row.results
    ]
    marks = {name for name, _ in named} | ({"differs"} if row.differs else set())
    badges = (tag("span", label, class_=f"badge v-{name}") for name, label in named)
    return filled(
        _CASE,
        index=index,
        id=row.id,
        clause=row.clause,
        group=row.group,
        marks=" ".join(sorted(marks)),
        badges=joined(badges),
        dim="" if words else " dim",
        words=words or worst.requirement,
    )


_Number = Callable[[str], int]
"""Gives a string's place in the table in which every string stands once."""


def case_data(
    reports: Sequence[Report], told: Sequence[str], cases: Sequence[Row], protocol: Protocol
) -> dict[str, Any]:
    """The data that the page's script draws: for each row each report's case, null for none."""
    table: dict[str, int] = {}

    def strings(words: str) -> int:
        return table.setdefault(words, len(table))

    words = [WireWords(protocol, report) for report in reports]
    drawn = [
        [
            result and _case(strings, told_by, result)
            for told_by, result in zip(words, row.results, strict=True)
        ]
        for row in cases
    ]
    rest_on = {axis.reading for row in cases for r in row.results if r for axis in r.axes.values()}
    rest_on |= {result.reading for row in cases for result in row.results if result}
    readings = {
        reading.id: {
            "clause": reading.clause,
            "point": reading.point,
            "quote": reading.quote,
            "default": reading.default,
            "others": reading.others,
        }
        for reading in READINGS
        if reading.id in rest_on
    }
    return {
        "runs": list(told),
        "known": [told_by.known for told_by in words],
        "readings": readings,
        "cases": drawn,
        "strings": list(table),
    }


def _clauses(result: CaseResult) -> str:
    """The case's own clause, and the one that its failure violates where that is another."""
    planned = result.planned_clause
    return planned if result.clause == planned else f"{planned}; what fails: {result.clause}"


def _case(strings: _Number, words: WireWords, result: CaseResult) -> dict[str, Any]:
    return {
        "v": result.verdict.label,
        "c": strings(_clauses(result)),
        "q": strings(result.requirement),
        "r": strings(result.reading or ""),
        "a": [
            [strings(name), axis.verdict.label]
            + [strings(w) for w in (axis.expected, axis.actual, axis.reason, axis.reading or "")]
            for name in AXES
            if (axis := result.axes.get(name))
        ],
        "s": [strings(frame) for frame in result.sent],
        "again": strings(result.reproduce),
        "log": [
            [event.ns // 1000, _KINDS[event.kind], strings(event.hex), strings(meaning)]
            for event, meaning in zip(result.log, words.of(result.log), strict=True)
        ],
    }


class WireWords:
    """The words for the wire logs of one report.

    `known` is false for a report that was made with another grammar than `protocol`: its bytes are
    not described. Frames are described as a conforming device would find them in the bytes.
    """

    def __init__(self, protocol: Protocol, report: Report) -> None:
        self.known = report.grammar.sha256 == protocol.sha256
        self._protocol = protocol
        measured = report.profile.truncation_timeout_ms
        self._timeout = int((measured or protocol.timing.truncation_timeout) * MS)
        self._frame = lru_cache(maxsize=None)(self._describe)

    def of(self, log: Iterable[WireEvent]) -> Iterator[str]:
        """The words for each entry of a log."""
        framer = Framer(self._protocol, self._timeout)
        for event in log:
            if event.look or not self.known:
                yield event.look
            elif event.kind == "sent":
                yield self._sent(framer, event)
            else:
                framer.advance(event.ns + self._timeout // 2)  # an answer ends a frame with a pause
                codes = bytes.fromhex(event.hex)
                yield _told(code_words(self._protocol, code) for code in codes)

    def _sent(self, framer: Framer, event: WireEvent) -> str:
        framer.advance(event.ns)
        begun = bool(framer.held)
        words = [
            self._frame(frame.data) for frame in framer.feed(bytes.fromhex(event.hex), event.ns)
        ]
        if begun:
            words.insert(0, "(goes on)")
        if framer.held:
            words.append(f"{judge(self._protocol, framer.held).describe()} so far")
        return _told(words)

    def _describe(self, frame: bytes) -> str:
        judgement = judge(self._protocol, frame)
        if judgement.valid:
            return judgement.describe()
        due = code_words(self._protocol, judgement.response.code)
        return f"{judgement.describe()} (faulty, {due} is due)"


def _told(words: Iterable[str]) -> str:
    """The words one after another, equal ones counted."""
    counted = ((word, len(list(run))) for word, run in groupby(words))
    return ", ".join(word if count == 1 else f"{count} × {word}" for word, count in counted)


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


def _tallied(results: Sequence[CaseResult | None], link: Callable[[str, str, str], Safe]) -> Safe:
    """One report's verdicts on some cases, the worst first."""
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
