"""Puts cases together for every format of a report: by group, by verdict, by reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TypeVar

from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.report.side_by_side import Row

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
        ("1 case" if count == 1 else f"{count} cases", first[reason], reason)
        for reason, count in counts.most_common()
    ]
