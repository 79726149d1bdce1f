"""The score of causes: what a planted fault's causes are worth."""

from __future__ import annotations

import pytest

from bilprov.conformance.mutation.explanations import (
    CauseScore,
    Explained,
    cause_score,
    drawn_pairs,
    explained,
)
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.spec.protocol import Protocol


def test_a_fault_is_one_cause_that_names_it_and_shows(protocol: Protocol) -> None:
    found = explained(protocol, ["no-stop-on-bad-data"], "smoke", 1)
    assert (found.causes, found.named, found.of, found.shown) == (1, 1, 1, True)
    assert found.failed > 1
    assert found.unexplained == 0


@pytest.mark.slow
def test_of_two_faults_each_has_its_cause(protocol: Protocol) -> None:
    score = cause_score(protocol, ["no-stop-on-truncated", "speed-bit-0-lost"], 1, "smoke")
    [both] = score.pairs
    assert both.name == "no-stop-on-truncated and speed-bit-0-lost"
    assert (both.named, both.of) == (2, 2)
    assert list(score.sentences()) == [
        "2 of 2 faults are exactly one cause, which names the trigger if it is known",
        "2 of 2 faults are at most two causes",
        "2 of 2 first causes show with their line on a device just switched on",
        "1 of 1 pairs have both faults among the first 3 causes",
    ]


def test_what_is_not_named_is_not_counted() -> None:
    other = Explained("other", 5, causes=1, named=0, of=1, shown=False)
    many = Explained("many", 5, causes=3, named=1, of=1, shown=True)
    unseen = Explained("unseen", 0)
    score = CauseScore((other, many, unseen), ())
    assert [sentence.split(" ")[0] for sentence in score.sentences()] == ["0", "1", "1"]


def test_pairs_are_of_different_families_and_drawn_by_the_seed(protocol: Protocol) -> None:
    bank = fault_bank(protocol)
    pairs = drawn_pairs(protocol, list(bank), 20, 7)
    assert pairs == drawn_pairs(protocol, list(bank), 20, 7)
    assert pairs != drawn_pairs(protocol, list(bank), 20, 8)
    assert all(bank[one].family != bank[other].family for one, other in pairs)
