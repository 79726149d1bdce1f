"""Puts cases together for every format of a report: by group, verdict, reason, side by side.

Also: what changed between two runs, which cases are fixed or fail now, and which causes. Pure.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

from bilprov.captures.text import quantity
from bilprov.conformance.oracle.verdicts import VOUCHED, CaseResult, Cause, Verdict
from bilprov.conformance.report.run_report import Report


class Row(NamedTuple):
    """One case: its id, and its result in each report, None where a report has no such case."""

    id: str
    results: tuple[CaseResult | None, ...]

    @property
    def any(self) -> CaseResult:
        """The first result there is; what it says of the case itself is the same in all."""
        return next(result for result in self.results if result)

    @property
    def clause(self) -> str:
        """The clause that the case stands under: the same whether it passes or fails."""
        return self.any.planned_clause

    @property
    def group(self) -> str:
        """The first part of the case's id."""
        return self.any.group

    @property
    def differs(self) -> bool:
        """Whether the verdicts of the reports that have the case differ."""
        return len({result.verdict for result in self.results if result}) > 1


def rows(reports: Sequence[Report]) -> list[Row]:
    """Every case of any report: those of the first in its order, then what only others have."""
    found = [{result.id: result for result in report.results} for report in reports]
    order = dict.fromkeys(ident for results in found for ident in results)
    return [Row(ident, tuple(results.get(ident) for results in found)) for ident in order]


def _tested(report: Report) -> str:
    """The device, and the fault that was set."""
    return report.device + (f" --fault {report.fault}" if report.fault else "")


def names(reports: Sequence[Report]) -> list[str]:
    """A name for each report: its device; of several its file, if any, and when the run began."""
    if len(reports) == 1:
        return [_tested(reports[0])]
    named = []
    for report in reports:
        begun = f" ({report.begun[:16].replace('T', ' ')} UTC)" if report.begun else ""
        named.append((report.file or _tested(report)) + begun)
    return named


Case = TypeVar("Case", CaseResult, Row)


def by_group(cases: Iterable[Case]) -> dict[str, list[Case]]:
    """The cases of each group, in the order of the first case of each."""
    groups: dict[str, list[Case]] = {}
    for case in cases:
        groups.setdefault(case.group, []).append(case)
    return groups


def tally(results: Iterable[CaseResult | None]) -> dict[Verdict, int]:
    """How many of the results have each verdict, the worst first; missing ones do not count."""
    counts = Counter(result.verdict for result in results if result)
    return {verdict: counts[verdict] for verdict in reversed(Verdict) if counts[verdict]}


def by_reason(results: Sequence[CaseResult]) -> list[tuple[str, str, str]]:
    """How many cases (in words) share a reason, the first one's id, and the reason.

    The reason that most cases share comes first.
    """
    counts = Counter(result.reason for result in results)
    first = {result.reason: result.id for result in reversed(results)}
    return [
        (quantity(count, "case"), first[reason], reason) for reason, count in counts.most_common()
    ]


# By whether the case failed in the first run and in the last; None where it was not judged.
_CASES = {
    (True, False): "fixed",
    (True, True): "still failing",
    (True, None): "failed before, not judged now",
    (None, True): "failing, not judged before",
    (False, True): "newly failing",
}


def changed_cases(cases: Sequence[Row]) -> dict[str, list[str]]:
    """The ids of the cases that failed in the first or the last run, by what became of them."""
    found: dict[str, list[str]] = {change: [] for change in _CASES.values()}
    for row in cases:
        change = _CASES.get((_failed(row.results[0]), _failed(row.results[-1])))
        if change:
            found[change].append(row.id)
    return {change: ids for change, ids in found.items() if ids}


def _failed(result: CaseResult | None) -> bool | None:
    if result is None or result.verdict not in (*VOUCHED, Verdict.FAIL):
        return None
    return result.verdict is Verdict.FAIL


class CauseChange(NamedTuple):
    """A cause of the first or the last run and what became of it; `before` is how it was said."""

    change: str
    cause: Cause
    before: str = ""


def changed_causes(first: Sequence[Cause], last: Sequence[Cause]) -> list[CauseChange]:
    """What became of each cause: two are the same if their sentences are.

    One that is said in another way now, and explains a case that it explained before, is changed.
    Of several it is one under the same condition, else the one with most cases alike.
    """
    said = {cause.sentence for cause in first} & {cause.sentence for cause in last}
    new = {cause.sentence: cause for cause in last if cause.sentence not in said}
    changes = []
    for cause in first:
        if cause.sentence in said:
            changes.append(CauseChange("still there", cause))
        elif after := _likest(cause, new.values()):
            changes.append(CauseChange("changed", new.pop(after.sentence), cause.sentence))
        else:
            changes.append(CauseChange("gone", cause))
    return changes + [CauseChange("new", cause) for cause in new.values()]


def _likest(before: Cause, causes: Iterable[Cause]) -> Cause | None:
    """The cause that has become of one, None where none of them explains a case that it did."""

    def alike(cause: Cause) -> tuple[bool, int]:
        return cause.when == before.when, len(set(cause.cases) & set(before.cases))

    return max((cause for cause in causes if alike(cause)[1]), key=alike, default=None)
