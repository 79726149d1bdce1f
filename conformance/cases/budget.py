"""Selects the cases that add the most coverage per second within a time budget.

Pure: takes the cases and their estimated seconds, returns the chosen cases in the order given.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Sequence

from bilprov.conformance.cases.coverage import Fact, facts
from bilprov.conformance.cases.levels import SEQUENCE_PREFIXES, AnyCase
from bilprov.spec.protocol import Protocol


def within(
    protocol: Protocol,
    cases: Sequence[AnyCase],
    budget: float,
    seconds: Callable[[AnyCase], float],
) -> tuple[AnyCase, ...]:
    """The cases that fit into `budget` s and together exercise the most, in the order given.

    The next case chosen is always the one that adds the most facts (see `coverage`) per second;
    cases that add none are chosen last, as long as there is time.
    """
    told = {case.id: frozenset(facts(protocol, case)) for case in cases}
    cost = {case.id: max(seconds(case), 1e-4) for case in cases}
    order = {case.id: index for index, case in enumerate(cases)}
    met: set[Fact] = set()
    chosen: set[str] = set()
    # A case adds fewer facts as others are chosen, never more: an old estimate is never too low.
    heap = [(-len(told[case.id]) / cost[case.id], order[case.id], case.id) for case in cases]
    heapq.heapify(heap)
    left = budget
    while heap:
        _, index, ident = heapq.heappop(heap)
        worth = -len(told[ident] - met) / cost[ident]
        if heap and worth > heap[0][0]:
            heapq.heappush(heap, (worth, index, ident))
        elif cost[ident] <= left:
            chosen.add(ident)
            met |= told[ident]
            left -= cost[ident]
    return tuple(case for case in cases if case.id in chosen)


def dropped(cases: Sequence[AnyCase], chosen: Sequence[AnyCase]) -> dict[str, int]:
    """How many cases of each group were left out."""
    kept = {case.id for case in chosen}
    return dict(Counter(group(case.id) for case in cases if case.id not in kept))


def group(ident: str) -> str:
    """The group that a case belongs to: the first part of its id, for sequences the first two."""
    parts = 2 if ident.startswith(SEQUENCE_PREFIXES) else 1
    return "/".join(ident.split("/")[:parts])
