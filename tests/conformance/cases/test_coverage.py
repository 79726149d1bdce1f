"""Coverage: what a run exercised, counted against what there is."""

from __future__ import annotations

import pytest

from bilprov.conformance.api import Options, conform
from bilprov.conformance.cases.coverage import BAD, COMBINED, VALID, covered
from bilprov.conformance.cases.levels import level_cases
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol, load
from tests.support.grammars import undeclared

SPEED = '"speed" / Ranged(Byte, 0, 255)'


@pytest.fixture(scope="module", params=["0, 1000", "10, 60000"])
def two_bytes(request: pytest.FixtureRequest, grammar_text: str) -> Protocol:
    """A protocol whose speed has two bytes."""
    assert SPEED in grammar_text
    text = undeclared(grammar_text).replace(SPEED, f'"speed" / Ranged(Int16ub, {request.param})')
    return load(text.replace("BitStruct, Byte,", "BitStruct, Byte, Int16ub,"))


def require_no_more_than_there_is(grammar: Protocol, level: str) -> None:
    for name, (done, of) in covered(grammar, level_cases(grammar, level, 1)).items():
        assert 0 < done <= of, name


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("level", ["smoke", "standard"])
def test_no_more_is_covered_than_there_is(each_protocol: Protocol, level: str) -> None:
    require_no_more_than_there_is(each_protocol, level)


@pytest.mark.slow
def test_no_more_is_covered_than_there_is_where_a_value_has_two_bytes(two_bytes: Protocol) -> None:
    require_no_more_than_there_is(two_bytes, "smoke")


@pytest.mark.slow
def test_frames_of_two_data_bytes_are_counted_out_of_all_there_are(two_bytes: Protocol) -> None:
    (speed,) = two_bytes.by_name["Speed"].fields
    in_two = [speed.build(value) for value in range(speed.low, speed.high + 1)]
    one_byte = [bytes([value]) for value in range(256)]
    frames = [
        bytes([two_bytes.header_bytes[spec.id, spec.length]]) + data
        for spec in two_bytes.instructions
        for data in ([b""], one_byte, in_two)[spec.length]
    ]
    good = [frame for frame in frames if judge(two_bytes, frame).valid]

    counts = covered(two_bytes, level_cases(two_bytes, "smoke", 1))

    assert counts[VALID][1] == len(good)
    assert counts[BAD][1] == 65536 - len(in_two) + len(frames) - len(good)


def test_a_sequence_that_was_not_run_covers_nothing(protocol: Protocol) -> None:
    options = Options(only=("combined/waited/*", "valid/Stop"), fail_fast=True)
    report = conform(Simulator(protocol, fault_bank(protocol)["always-1"]), options=options)

    unrun = [r for r in report.results if r.id.startswith("combined/waited/")]
    assert unrun
    assert {result.verdict for result in unrun} == {Verdict.SKIPPED}
    assert not any(result.counted for result in unrun)
    combined = [report.coverage.get(name) for name in COMBINED.values()]
    assert not any(covered and covered.done for covered in combined)
