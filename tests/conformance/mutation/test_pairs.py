"""Pairs of legal variants: no device that takes two other legal choices is called faulty."""

from __future__ import annotations

import pytest

from bilprov.captures.schemas import MS
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.variants import hooks_of, variants
from bilprov.spec.protocol import Protocol, load
from tests.support import ROOT
from tests.support.pairs import pairs

# xdist must collect the same tests everywhere: the names come from the kit's own grammar.
PAIRS = pairs(load((ROOT / "spec" / "grammar.py").read_text(encoding="utf-8"), "grammar.py"))


def test_almost_all_variants_are_in_pairs_and_none_that_needs_an_option() -> None:
    protocol = load((ROOT / "spec" / "grammar.py").read_text(encoding="utf-8"), "grammar.py")
    legal = {name for name, variant in variants(protocol).items() if not variant.row.allow}

    assert {part for name in PAIRS for part in name.split(" and ")} == legal
    assert len(PAIRS) > 1000


def test_a_pair_has_every_behaviour_of_both_parts(protocol: Protocol) -> None:
    for name, both in pairs(protocol).items():
        for part in (variants(protocol)[one].fault for one in name.split(" and ")):
            assert hooks_of(part).items() <= hooks_of(both).items(), name
            assert both.react or not part.react, name


def test_a_frame_that_is_lost_changes_nothing_and_a_late_answer_makes_its_stop_later(
    protocol: Protocol,
) -> None:
    """Speeds while it moves are kept for the next motion, unless they are lost; a stop is not."""
    both = pairs(protocol)
    robot = Simulator(
        protocol, both["R-pipelining=lost-after-a-fault and R-speed-moving=next-motion"]
    )
    robot.receive(bytes.fromhex("11 50 20 90 11 ff"), robot.byte_time)
    assert robot.advance(robot.byte_time) == bytes((0, 0, 1))
    robot.receive(b"\x20", 10 * MS)
    assert robot.look(10 * MS).speed == 0x50

    robot = Simulator(protocol, both["R-answer-deadline=60-ms and R-stop-latency=50-ms"])
    robot.receive(bytes.fromhex("11 50 20"), 0)
    robot.receive(b"\x90", 1000 * MS)
    assert robot.look(1109 * MS).moving
    assert not robot.look(1111 * MS).moving


@pytest.mark.sample(3)
@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(PAIRS))
def test_a_device_of_two_legal_readings_does_not_fail(name: str, protocol: Protocol) -> None:
    device = Simulator(protocol, pairs(protocol)[name])

    report = conform(device, grammar=protocol, options=Options(level="smoke"))

    assert report.exit not in (1, 2), max(report.results, key=lambda result: result.verdict)
