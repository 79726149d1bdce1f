"""Pairs of legal variants: no device that takes two other legal choices is called faulty."""

from __future__ import annotations

import pytest

from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import hooks_of, variants
from bilprov.spec.protocol import Protocol
from tests.support.faults import OWN
from tests.support.pairs import pairs

PAIRS = pairs(OWN)


def test_almost_all_variants_are_in_pairs_and_none_that_needs_an_option() -> None:
    legal = {name for name, variant in variants(OWN).items() if not variant.row.allow}

    assert {part for name in PAIRS for part in name.split(" and ")} == legal
    assert len(PAIRS) > 1000


def test_a_pair_has_every_behaviour_of_both_parts(protocol: Protocol) -> None:
    for name, both in pairs(protocol).items():
        for part in (variants(protocol)[one].fault for one in name.split(" and ")):
            assert hooks_of(part).items() <= hooks_of(both).items(), name
            assert both.react or not part.react, name


@pytest.mark.sample(3)
@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(PAIRS))
def test_a_device_of_two_legal_readings_does_not_fail(name: str, protocol: Protocol) -> None:
    device = Simulator(protocol, pairs(protocol)[name])

    report = conform(device, grammar=protocol, options=Options(level="smoke"))

    assert report.exit not in (1, 2), max(report.results, key=lambda result: result.verdict)
