"""Pairs of legal variants: no device that takes two other legal choices is called faulty."""

from __future__ import annotations

import pytest

from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.pairs import pairs
from bilprov.conformance.mutation.variants import variants
from bilprov.spec.protocol import Protocol, load
from tests.support import ROOT

# xdist must collect the same tests everywhere: the names come from the kit's own grammar.
PAIRS = pairs(load((ROOT / "spec" / "grammar.py").read_text(encoding="utf-8"), "grammar.py"))


def test_almost_all_variants_are_in_pairs_and_none_that_needs_an_option() -> None:
    protocol = load((ROOT / "spec" / "grammar.py").read_text(encoding="utf-8"), "grammar.py")
    legal = {name for name, variant in variants(protocol).items() if not variant.allow}

    assert {part for name in PAIRS for part in name.split(" and ")} == legal
    assert len(PAIRS) > 850


def test_two_choices_at_one_point_are_no_pair() -> None:
    assert "R-drive-steering=straight and R-rotate-steering=reset" in PAIRS
    for one, other in (name.split(" and ") for name in PAIRS):
        assert one.split("=")[0] != other.split("=")[0]


@pytest.mark.sample(40)
@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(PAIRS))
def test_a_device_of_two_legal_readings_does_not_fail(name: str, protocol: Protocol) -> None:
    device = Simulator(protocol, pairs(protocol)[name])
    report = conform(device, grammar=protocol, options=Options(level="smoke"))

    worst = max(report.results, key=lambda result: result.verdict)
    assert report.exit not in (1, 2), (worst.id, worst.reason)
