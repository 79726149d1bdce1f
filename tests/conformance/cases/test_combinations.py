"""Combinations: what a run covers, counted from its frames, and the random sequences after them."""

from __future__ import annotations

from itertools import islice

import pytest
from msgspec.structs import astuple

from bilprov.conformance.api import Options, conform, select_cases
from bilprov.conformance.cases.combinations import random_sequences, space_of, total
from bilprov.conformance.cases.coverage import COMBINED
from bilprov.conformance.cases.levels import level_cases
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.dut.simulator import Simulator
from bilprov.spec.protocol import Protocol

RANDOM = "combined/random/"


def randoms(protocol: Protocol, level: str, soaked: int = 0) -> list[SequenceCase]:
    cases = level_cases(protocol, level, 1, soaked)
    return [c for c in cases if isinstance(c, SequenceCase) and c.id.startswith(RANDOM)]


@pytest.mark.sample(1)
@pytest.mark.slow
def test_the_arrays_cover_every_feasible_combination_of_three(each_protocol: Protocol) -> None:
    def covered(*only: str) -> dict[str, tuple[int, int]]:
        robot, options = Simulator(each_protocol), Options(only=only)
        report = conform(robot, grammar=each_protocol, options=options, logged=False)
        return {name: astuple(report.coverage[name]) for name in COMBINED.values()}

    whole = covered("combined/waited/*", "combined/pipelined/*", "combined/split/*")
    for strength, name in COMBINED.items():
        assert whole[name] == (total(each_protocol, strength),) * 2
    assert covered("combined/pipelined/*")[name][0] < whole[name][0]


def test_every_frame_of_a_factor_fits_the_row_that_it_is_in(each_protocol: Protocol) -> None:
    space = space_of(each_protocol)

    assert len(space.sizes) == 11
    assert {shape.length for shape in space.shapes} == set(each_protocol.data_lengths)


def test_a_random_sequence_depends_on_its_number_and_the_seed_alone(protocol: Protocol) -> None:
    first = list(islice(random_sequences(protocol, 1), 4))

    assert list(islice(random_sequences(protocol, 1, 3), 2)) == first[2:]
    assert next(random_sequences(protocol, 2)).bursts != first[0].bursts
    assert [case.id for case in first] == [f"{RANDOM}{number:03}" for number in range(1, 5)]
    assert [any(len(b.steps) > 1 for b in case.bursts) for case in first] == [False, True] * 2


@pytest.mark.sample(0)
@pytest.mark.slow
def test_deep_has_ten_times_the_random_sequences_of_standard(protocol: Protocol) -> None:
    standard, deep = randoms(protocol, "standard"), randoms(protocol, "deep")

    assert len(deep) == 10 * len(standard) > 0
    assert deep[: len(standard)] == standard


@pytest.mark.sample(0)
@pytest.mark.slow
def test_a_random_sequence_of_a_soak_is_made_again_by_its_id(protocol: Protocol) -> None:
    beyond = randoms(protocol, "standard")[-1].id
    number = int(beyond.rpartition("/")[2]) + 5
    again = f"{beyond.rpartition('/')[0]}/{number:03}"

    (case,) = select_cases(protocol, Options(only=(again,)))

    assert case.id == again
    assert len(select_cases(protocol, Options(only=(f"{RANDOM}*",)))) == number - 5


@pytest.mark.slow
def test_sequences_that_pass_are_kept_as_counts_and_others_whole(protocol: Protocol) -> None:
    options = Options(only=(f"{RANDOM}00?",))
    good = conform(Simulator(protocol), grammar=protocol, options=options)

    kept = [result for result in good.results if result.id.startswith(RANDOM)]
    assert len(kept) == 9
    assert all(result.frames >= 64 for result in kept)
    assert {(result.sent, result.received, result.log) for result in kept} == {((), (), ())}
