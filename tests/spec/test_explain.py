"""Explanations: they account for every bit and say what follows from it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.codec import judge
from bilprov.spec.explain import BitGroup, explain, explain_responses
from bilprov.spec.protocol import load
from bilprov.spec.readings import READINGS

PROTOCOL = load_protocol()
FROM_IDS = {reading.id for reading in READINGS}


def only(frame: str):  # type: ignore[no-untyped-def]
    (one,) = explain(PROTOCOL, bytes.fromhex(frame)).frames
    return one


@given(st.binary(max_size=60))
def test_every_bit_stands_in_exactly_one_group(data: bytes) -> None:
    explanation = explain(PROTOCOL, data)
    assert b"".join(frame.judgement.frame for frame in explanation.frames) == data
    for frame in explanation.frames:
        bits = "".join(group.bits for group in frame.groups)
        assert bits == "".join(f"{byte:08b}" for byte in frame.judgement.frame)
        for group in frame.groups:
            assert len(group.bits) == group.high - group.low + 1
            assert group.meaning
        assert frame.missing == frame.judgement.length + 1 - len(frame.judgement.frame)
        assert (frame.nearest is None) == frame.judgement.valid
        assert bool(frame.differences) != frame.judgement.valid
        assert any(group.fault for group in frame.groups) <= (not frame.judgement.valid)


@given(st.binary(max_size=60))
def test_a_faulty_frame_stops_and_its_nearest_is_valid(data: bytes) -> None:
    for frame in explain(PROTOCOL, data).frames:
        if frame.nearest:
            assert frame.stops
            assert frame.nearest.valid


def test_named_bits_are_told_one_by_one() -> None:
    groups = only("81 05").groups
    assert [(g.name, g.value, g.meaning) for g in groups[3:]] == [
        ("R", 1, "on"),
        ("G", 0, "off"),
        ("B", 1, "on"),
    ]
    assert groups[2] == BitGroup(1, 1, 7, 3, "00000", "rgb", 0, "upper bits, must be 0")


def test_an_unnamed_field_is_told_with_its_range() -> None:
    assert only("11 7f").groups[2] == BitGroup(
        1, 1, 7, 0, "01111111", "speed", 127, "speed that the other instructions use, 0 to 255"
    )


@pytest.mark.parametrize(
    ("frame", "faulty"),
    [
        ("11 7f", []),
        ("81 09", ["rgb"]),
        ("91 02", ["id"]),
        ("13 01 02 03", ["length"]),
        ("40", ["length"]),
        ("11", []),
    ],
)
def test_the_bits_that_make_it_faulty_are_marked(frame: str, faulty: list[str]) -> None:
    assert [group.name for group in only(frame).groups if group.fault] == faulty


@pytest.mark.parametrize(
    ("frame", "changes", "keeps"),
    [
        ("20", {"motion": "forward"}, ("speed", "steering", "led")),
        ("51 0a", {"steering": "-10"}, ("motion", "speed", "led")),
        ("00", {"motion": "stopped", "steering": "0"}, ("speed", "led")),
        ("f0", {"motion": "stopped", "steering": "0"}, ("speed", "led")),
    ],
)
def test_the_change_of_state_is_told_in_words(
    frame: str, changes: dict[str, str], keeps: tuple[str, ...]
) -> None:
    assert dict(only(frame).changes) == changes
    assert only(frame).keeps == keeps


@pytest.mark.parametrize(
    ("frame", "ids"),
    [
        ("11 7f", []),
        ("81 09", ["R-led-upper-bits"]),
        ("11", ["R-truncated-known", "R-truncation-timeout"]),
        ("13 05", ["R-truncated-long", "R-truncation-timeout"]),
        ("f1", ["R-truncated-unused", "R-truncation-timeout"]),
        ("f0", []),
        ("f1 00", ["R-unused-length", "R-drain-unused"]),
        ("12 00 00", ["R-known-length", "R-drain-known"]),
    ],
)
def test_the_readings_it_rests_on_are_named(frame: str, ids: list[str]) -> None:
    assert [reading.id for reading in only(frame).readings] == ids
    assert FROM_IDS.issuperset(ids)


def test_only_a_frame_cut_short_waits_for_the_time_out() -> None:
    assert only("11").answer == "TOO_FEW_DATA, code 04, once 50 ms have passed without a byte"
    assert only("10").answer == "TOO_FEW_DATA, code 04"


def test_the_examples_that_contradict_the_document_name_their_erratum() -> None:
    right, swallowed = explain(PROTOCOL, bytes.fromhex("40 ff")).frames
    assert [erratum.id for erratum in right.errata] == ["E3"]
    assert "R-example-right" in {reading.id for reading in right.readings}
    assert right.nearest
    assert right.nearest.frame.hex(" ") == "41 ff"
    assert right.differences == ("length 0 becomes 1", "ff is taken from what follows")
    assert swallowed.errata == ()
    led = only("91 02")
    assert [erratum.id for erratum in led.errata] == ["E5"]
    assert led.differences == ("id 9 becomes 8",)
    assert only("91 03").errata == ()


@pytest.mark.parametrize(
    ("frame", "differences"),
    [
        ("81 09", ("byte 1 09 becomes 01",)),
        ("11", ("00 is added",)),
        ("12 05 06", ("length 2 becomes 1", "06 is left out")),
    ],
)
def test_the_nearest_valid_frame_says_how_it_differs(
    frame: str, differences: tuple[str, ...]
) -> None:
    assert only(frame).differences == differences


def test_each_byte_of_the_device_is_a_response() -> None:
    ok, unused = explain_responses(PROTOCOL, b"\x00\x05").responses
    assert ok.response
    assert (ok.response.name, ok.group.fault) == ("OK", False)
    assert "stops" not in ok.meaning
    assert (unused.response, unused.group.fault) == (None, True)
    assert unused.meaning == "unused: a device that sends one does not conform"


def test_a_field_of_two_bytes_is_one_group() -> None:
    source = PROTOCOL.source.replace(
        "from construct import ", "from construct import Int16ub, "
    ).replace('"speed" / Ranged(Byte, 0, 255)', '"speed" / Ranged(Int16ub, 0, 1000)')
    (frame,) = explain(load(source), bytes.fromhex("12 03 e9")).frames
    group = frame.groups[2]
    assert (group.byte, group.size, group.high, group.value, group.fault) == (1, 2, 15, 1001, True)
    assert group.bits == "0000001111101001"
    assert frame.judgement.valid is judge(load(source), bytes.fromhex("12 03 e9")).valid is False
