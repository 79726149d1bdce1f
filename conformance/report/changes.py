"""What changed between two runs: which cases are fixed or fail now, and which causes. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from bilprov.conformance.oracle.verdicts import CaseResult, Cause, Verdict
from bilprov.conformance.report.grouping import Row

_FINE = (Verdict.PASS, Verdict.INFORMATIONAL, Verdict.NON_STRICT)

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
    if result is None or result.verdict not in (*_FINE, Verdict.FAIL):
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
    """
    said = {cause.sentence for cause in first} & {cause.sentence for cause in last}
    left = [cause for cause in last if cause.sentence not in said]
    changes = []
    for cause in first:
        if cause.sentence in said:
            changes.append(CauseChange("still there", cause))
            continue
        other = next((one for one in left if set(one.cases) & set(cause.cases)), None)
        if other is None:
            changes.append(CauseChange("gone", cause))
        else:
            left.remove(other)
            changes.append(CauseChange("changed", other, cause.sentence))
    return changes + [CauseChange("new", cause) for cause in left]
