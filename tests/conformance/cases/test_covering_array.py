"""Covering arrays: every feasible combination, no other, and few rows for what is dear."""

from __future__ import annotations

from itertools import combinations, product
from random import Random

from hypothesis import given
from hypothesis import strategies as st

from bilprov.conformance.cases.combinations import CoveringArray, Partial, feasible_combinations

SIZES = st.lists(st.integers(1, 4), min_size=3, max_size=5)
SEEDS = st.integers(0, 1 << 32)


def anything(chosen: Partial) -> bool:
    return True


def held(rows: tuple[tuple[int, ...], ...], strength: int) -> set[tuple[tuple[int, int], ...]]:
    return {pairs for row in rows for pairs in combinations(enumerate(row), strength)}


@given(SIZES, st.integers(1, 3), SEEDS)
def test_every_combination_stands_in_a_row(sizes: list[int], strength: int, seed: int) -> None:
    rows = CoveringArray(sizes, strength, anything, Random(seed)).rows

    every = {
        tuple(zip(factors, values, strict=True))
        for factors in combinations(range(len(sizes)), strength)
        for values in product(*(range(sizes[factor]) for factor in factors))
    }
    assert held(rows, strength) == every


@given(SIZES, SEEDS)
def test_what_cannot_be_stands_in_no_row_and_all_else_does(sizes: list[int], seed: int) -> None:
    """The first and the last factor never have the same value, unless one has no other."""

    def feasible(chosen: Partial) -> bool:
        last = len(sizes) - 1
        if 0 in chosen and last in chosen:
            return chosen[0] != chosen[last] or chosen[0] == 0
        return True

    rows = CoveringArray(sizes, 2, feasible, Random(seed)).rows

    assert all(feasible(dict(enumerate(row))) for row in rows)
    assert held(rows, 2) == set(feasible_combinations(sizes, 2, feasible))


def test_a_dear_value_stands_in_no_more_rows_than_needed() -> None:
    sizes, dear = (4, 4, 2), (2, 1)

    def standing(values: set[tuple[int, int]]) -> int:
        rows = CoveringArray(sizes, 2, anything, Random(7), dear=values).rows
        return sum(row[dear[0]] == dear[1] for row in rows)

    assert 4 <= standing({dear}) < standing(set())


def test_a_seed_gives_the_same_rows() -> None:
    first, again, other = (
        CoveringArray((3, 4, 5, 2), 3, anything, Random(seed)).rows for seed in (1, 1, 2)
    )

    assert first == again
    assert first != other
