"""Coverage: what a run exercised, counted against what there is."""

from __future__ import annotations

import pytest

from bilprov.conformance.cases.coverage import BAD, VALID, covered
from bilprov.conformance.cases.levels import level_cases
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol, load

SPEED = '"speed" / Ranged(Byte, 0, 255)'


@pytest.fixture(scope="module", params=["0, 1000", "10, 60000"])
def wide(request: pytest.FixtureRequest, grammar_text: str) -> Protocol:
    """A protocol whose speed has two bytes."""
    assert SPEED in grammar_text
    text = grammar_text.replace(SPEED, f'"speed" / Ranged(Int16ub, {request.param})')
    return load(text.replace("BitStruct, Byte,", "BitStruct, Byte, Int16ub,"))


@pytest.mark.slow
@pytest.mark.parametrize("level", ["smoke", "standard"])
def test_no_more_is_covered_than_there_is(
    protocol: Protocol, horn: Protocol, wide: Protocol, level: str
) -> None:
    for grammar in (protocol, horn, wide):
        for name, (done, of) in covered(grammar, level_cases(grammar, level, 1)).items():
            assert 0 < done <= of, name


@pytest.mark.slow
def test_frames_of_two_data_bytes_are_counted_out_of_all_there_are(wide: Protocol) -> None:
    (speed,) = wide.by_name["Speed"].fields
    two_bytes = [speed.build(value) for value in range(speed.low, speed.high + 1)]
    one_byte = [bytes([value]) for value in range(256)]
    frames = [
        bytes([wide.header_bytes[spec.id, spec.length]]) + data
        for spec in wide.instructions
        for data in ([b""], one_byte, two_bytes)[spec.length]
    ]
    good = [frame for frame in frames if judge(wide, frame).valid]

    counts = covered(wide, level_cases(wide, "smoke", 1))

    assert counts[VALID][1] == len(good)
    assert counts[BAD][1] == 65536 - len(two_bytes) + len(frames) - len(good)
