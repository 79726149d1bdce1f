"""The cases of a page: a list that needs no script, and the data that is drawn on a click.

Every string stands once in the data, in one table; the cases refer to it by number.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bilprov.captures.text import escape_controls
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.report.html.markup import Safe, joined, tag
from bilprov.conformance.report.run_report import AXES, Report, reproduce
from bilprov.conformance.report.side_by_side import Row
from bilprov.conformance.report.wire_words import WireWords
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import READINGS

_KINDS = {"sent": 0, "received": 1, "look": 2, "clipped": 3}


def case_rows(cases: Sequence[Row]) -> Safe:
    """One row for each case, closed; its details are drawn when it is opened."""
    return joined(_row(index, row) for index, row in enumerate(cases))


def _row(index: int, row: Row) -> Safe:
    worst = max((result for result in row.results if result), key=lambda r: r.verdict)
    words = worst.reason if worst.verdict is not Verdict.PASS else ""
    marks = {result.verdict.label if result else "missing" for result in row.results}
    if row.differs:
        marks.add("differs")
    badges = [
        tag("span", label, class_=f"badge v-{name}")
        for name, label in ((r.verdict.label, r.verdict.label) if r else ("missing", "not run")
        for r in row.results)
    ]  # fmt: skip
    summary = tag(
        "summary",
        tag("span", *badges, class_="badges"),
        tag("span", row.id, class_="id"),
        tag("span", words or worst.requirement, class_="why" if words else "why dim"),
    )
    return tag(
        "details",
        summary,
        data_i=index,
        data_id=row.id,
        data_c=row.clause,
        data_g=row.group,
        data_v=" ".join(sorted(marks)),
    )


class _Strings:
    """A table in which every string stands once."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}

    def __call__(self, words: str) -> int:
        return self._numbers.setdefault(escape_controls(words), len(self._numbers))

    @property
    def all(self) -> list[str]:
        return list(self._numbers)


def case_data(
    reports: Sequence[Report], told: Sequence[str], cases: Sequence[Row], protocol: Protocol
) -> dict[str, Any]:
    """The data that the page's script draws: for each row each report's case, null for none."""
    strings = _Strings()
    words = [WireWords(protocol, report) for report in reports]
    drawn = [
        [
            result and _case(strings, report, told_by, result)
            for report, told_by, result in zip(reports, words, row.results, strict=True)
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
        "runs": [escape_controls(name) for name in told],
        "known": [told_by.known for told_by in words],
        "readings": readings,
        "cases": drawn,
        "strings": strings.all,
    }


def _clauses(result: CaseResult) -> str:
    """The case's own clause, and the one that its failure violates where that is another."""
    more = f"; what fails: {result.clause}" if result.planned else ""
    return f"{result.own_clause}{more}"


def _case(
    strings: _Strings, report: Report, words: WireWords, result: CaseResult
) -> dict[str, Any]:
    return {
        "v": result.verdict.label,
        "c": strings(_clauses(result)),
        "q": strings(result.requirement),
        "r": strings(result.reading),
        "a": [
            [strings(name), axis.verdict.label]
            + [strings(w) for w in (axis.expected, axis.actual, axis.reason, axis.reading)]
            for name in AXES
            if (axis := result.axes.get(name))
        ],
        "s": [strings(frame) for frame in result.sent],
        "again": strings(reproduce(report, result)),
        "log": [
            [event.t // 1000, _KINDS[event.kind], strings(event.hex), strings(meaning)]
            for event, meaning in zip(result.log, words.of(result.log), strict=True)
        ],
    }
