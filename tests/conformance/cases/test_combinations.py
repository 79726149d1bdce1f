"""Combinations of frames, and the arrays that cover them."""

from __future__ import annotations

from itertools import combinations, islice, product
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import astuple

from bilprov.conformance.api import Options, conform
from bilprov.conformance.cases.combinations import (
    CoveringArray,
    Partial,
    feasible_combinations,
    random_sequences,
    total,
)
from bilprov.conformance.cases.levels import COMBINED
from bilprov.conformance.dut.simulator import Simulator
from bilprov.spec.protocol import Protocol

RANDOM = "combined/random/"


@pytest.mark.sample(0)
@pytest.mark.slow
def test_the_arrays_cover_every_feasible_combination_of_three(each_protocol: Protocol) -> None:
    only = ("combined/waited/*", "combined/pipelined/*", "combined/split/*")
    report = conform(grammar=each_protocol, options=Options(only=only), logged=False)

    for strength, name in COMBINED.items():
        assert astuple(report.coverage[name]) == (total(each_protocol, strength),) * 2


def test_a_random_sequence_depends_on_its_number_and_the_seed_alone(protocol: Protocol) -> None:
    first = list(islice(random_sequences(protocol, 1), 4))

    assert list(islice(random_sequences(protocol, 1, 3), 2)) == first[2:]
    assert next(random_sequences(protocol, 2)).bursts != first[0].bursts
    assert [case.id for case in first] == [f"{RANDOM}{number:03}" for number in range(1, 5)]
    assert [any(len(b.steps) > 1 for b in case.bursts) for case in first] == [False, True] * 2


@pytest.mark.slow
def test_sequences_that_pass_are_kept_as_counts_and_others_whole(protocol: Protocol) -> None:
    options = Options(only=(f"{RANDOM}001", f"{RANDOM}002"))
    good = conform(Simulator(protocol), grammar=protocol, options=options)

    kept = [result for result in good.results if result.id.startswith(RANDOM)]
    assert len(kept) == 2
    assert all(result.frames >= 64 for result in kept)
    assert {(result.sent, result.received, result.log) for result in kept} == {((), (), ())}


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
