"""Covering arrays: rows in which every feasible combination of any `strength` factors occurs.

Greedy: each row is begun with a combination that is not covered yet; the rest of it is drawn at
random, with a preference for values that are new beside those of the first factors, which should be
the ones with the most values, because they decide how many rows are needed.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from itertools import combinations, islice, product

Row = tuple[int, ...]
"""One value of each factor, by its index."""
Partial = Mapping[int, int]
"""The values chosen so far: value index by factor index."""

_DRAWS = 3  # values drawn for a factor, of which one that covers something new is taken


def feasible_combinations(
    sizes: Sequence[int], strength: int, feasible: Callable[[Partial], bool]
) -> Iterator[tuple[tuple[int, int], ...]]:
    """Yield every feasible combination of the values of `strength` factors, as (factor, value)."""
    for factors in combinations(range(len(sizes)), strength):
        for values in product(*(range(sizes[factor]) for factor in factors)):
            pairs = tuple(zip(factors, values, strict=True))
            if feasible(dict(pairs)):
                yield pairs


class CoveringArray:
    """Rows over factors with `sizes` values each, and what they cover.

    `feasible` says whether values chosen so far can be completed to a row; it must be exact, so
    that a row is never begun in vain. `dear` are (factor, value) pairs that stand in no more rows
    than needed; `rows` hold every feasible combination of `strength` factors.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        strength: int,
        feasible: Callable[[Partial], bool],
        draw: random.Random,
        *,
        dear: Container[tuple[int, int]] = (),
    ) -> None:
        self._sizes = tuple(sizes)
        self._feasible = feasible
        self._draw = draw
        self._strength = strength
        self._dear = dear
        self._covered: set[tuple[int, ...]] = set()
        # A value's number is unique over all factors, so that a combination is a tuple of numbers.
        self._first = tuple(sum(self._sizes[:index]) for index in range(len(self._sizes)))
        wanted = list(feasible_combinations(sizes, strength, feasible))
        draw.shuffle(wanted)
        self.rows = tuple(self._rows(wanted))

    def _rows(self, wanted: Sequence[tuple[tuple[int, int], ...]]) -> Iterator[Row]:
        first = self._first
        for pairs in wanted:
            if tuple(first[factor] + value for factor, value in pairs) in self._covered:
                continue
            row = self._completed(dict(pairs))
            self._covered.update(self._held(row))
            yield row

    def _held(self, row: Row) -> Iterator[tuple[int, ...]]:
        """The combinations that a row holds."""
        numbers = (base + value for base, value in zip(self._first, row, strict=True))
        return combinations(numbers, self._strength)

    def _completed(self, chosen: dict[int, int]) -> Row:
        """A row with these values; the others are drawn."""
        factors = range(len(self._sizes))
        for factor in factors:
            if factor not in chosen:
                chosen[factor] = self._value(factor, chosen)
        return tuple(chosen[factor] for factor in factors)

    def _value(self, factor: int, chosen: Partial) -> int:
        """A value that can stand beside those chosen, if possible one not covered beside them."""
        sample = self._draw.sample(range(self._sizes[factor]), self._sizes[factor])
        sample.sort(key=lambda value: (factor, value) in self._dear)
        allowed = (value for value in sample if self._feasible({**chosen, factor: value}))
        if factor < self._strength - 1:
            return next(allowed)
        beside = tuple(self._first[one] + chosen[one] for one in range(self._strength - 1))
        values = tuple(islice(allowed, _DRAWS))
        new = ((*beside, self._first[factor] + v) not in self._covered for v in values)
        return next((value for value, fresh in zip(values, new, strict=True) if fresh), values[0])
