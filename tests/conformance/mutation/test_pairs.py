"""Pairs of legal variants: no device that takes two other legal choices is called faulty."""

from __future__ import annotations

from dataclasses import fields

import pytest

from bilprov.captures.schemas import MS
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.fault import CONFORMING, Fault
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
    assert len(PAIRS) > 1000


def test_two_choices_at_one_point_are_no_pair() -> None:
    assert "R-drive-steering=straight and R-rotate-steering=reset" in PAIRS
    for one, other in (name.split(" and ") for name in PAIRS):
        assert one.split("=")[0] != other.split("=")[0]


def test_a_pair_has_every_behaviour_of_both_parts(protocol: Protocol) -> None:
    told = {
        "name",
        "family",
        "doc",
        "caught_by",
        "exit",
        "clauses",
        "needs",
        "what",
        "trigger",
        "history",
    }
    behaviour = {field.name for field in fields(Fault)} - told
    legal = variants(protocol)
    plateau = next(fault for name, fault in pairs(protocol).items() if "plateau" in name)
    assert plateau.show is not None

    for name, both in pairs(protocol).items():
        for part in (legal[one].fault for one in name.split(" and ")):
            for field in behaviour:
                own = getattr(part, field)
                if own == getattr(CONFORMING, field):
                    continue
                found = getattr(both, field)
                assert found is not None if callable(own) else found == own, (name, field)


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


# One of the two looks like another choice than it is, unless the suite tells them apart.
ALIKE = (
    "R-truncated-known=silent-and-others-answered and R-truncation-timeout=3-ms",
    "R-truncation-timeout=1500-ms and R-watchdog=stops",
    "R-truncation-timeout=whole-frame and R-answer-deadline=one-at-a-time",
    "R-truncation-timeout=3-ms and R-drain-known=flushed",
    "R-answer-deadline=one-at-a-time and R-pipelining=lost-after-a-fault",
    "R-answer-deadline=one-at-a-time and R-watchdog=stops",
)


def worst_of(protocol: Protocol, name: str) -> tuple[int, str, str]:
    device = Simulator(protocol, pairs(protocol)[name])
    report = conform(device, grammar=protocol, options=Options(level="smoke"))
    worst = max(report.results, key=lambda result: result.verdict)
    return report.exit, worst.id, worst.reason


@pytest.mark.slow
@pytest.mark.parametrize("name", ALIKE)
def test_what_two_choices_have_in_common_is_not_taken_for_a_third(
    name: str, protocol: Protocol
) -> None:
    assert worst_of(protocol, name)[0] == 0


@pytest.mark.sample(20)
@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(PAIRS))
def test_a_device_of_two_legal_readings_does_not_fail(name: str, protocol: Protocol) -> None:
    code, *worst = worst_of(protocol, name)

    assert code not in (1, 2), worst
