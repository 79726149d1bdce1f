"""A grammar with one more instruction, 9 "Horn": the whole kit follows it without other changes."""

from __future__ import annotations

import pytest

from bilprov.conformance.api import Options, conform
from bilprov.conformance.cases.levels import level_cases
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.protocol import Protocol
from tests.support.robots import failing

# Cases about the Horn: its values, what it refuses, other lengths, truncations. The sweeps have it
# in each of four motions: its values in one walk each,
# what it refuses (252 values, each with a motion before it, 64 bursts a walk) in eight.
HORNS = {"smoke": 1, "standard": 4 + 252 + 15 + 2 + 4 * (1 + 8)}


@pytest.mark.slow
@pytest.mark.parametrize("level", ["smoke", pytest.param("standard", marks=pytest.mark.sample(0))])
def test_a_robot_with_a_horn_conforms_to_its_grammar(horn: Protocol, level: str) -> None:
    cases = level_cases(horn, level, 1)
    only = () if level == "smoke" else tuple(case.id for case in cases[1::8])

    report = conform(grammar=horn, options=Options(level=level, only=only))

    assert report.exit == 0
    assert {result.verdict for result in report.results} == {Verdict.PASS}
    assert len([case for case in cases if "/Horn" in case.id]) == HORNS[level]
    tours = [case for case in cases if case.id.startswith("sequence/tour")]
    assert any(b"\x91" in data for tour in tours for data in tour.sent)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("has_horn", "only", "level", "caught"),
    [
        (False, ("valid/Horn/*", "unused-id/*", "valid/LED/*"), "standard", "valid/Horn/3"),
        (True, ("unused-id/*", "valid/LED/*", "bad-data/LED/1?"), "standard", "unused-id/9/1"),
        (True, (), "smoke", "unused-id/9/0"),
        pytest.param(True, (), "standard", "unused-id/9/1", marks=pytest.mark.sample(0)),
    ],
    ids=["a grammar with a horn", "one without", "one without, smoke", "one without, all cases"],
)
def test_a_robot_fails_the_grammar_that_differs_by_a_horn(
    protocol: Protocol,
    horn: Protocol,
    has_horn: bool,
    only: tuple[str, ...],
    level: str,
    caught: str,
) -> None:
    robot, grammar = Simulator(horn if has_horn else protocol), protocol if has_horn else horn

    report = conform(robot, grammar=grammar, options=Options(only=only, level=level))

    found = failing(report.results)
    assert report.exit == 1
    assert caught in found
    assert not [ident for ident in found if ident.startswith(("valid/LED", "bad-data/LED"))]
    assert only or {"sequence", "pipelined", "split"} <= {ident.split("/")[0] for ident in found}
