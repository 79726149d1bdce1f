"""Explanations: they account for every bit and say what follows from it."""

from __future__ import annotations

import re
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer import api
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.codec import judge
from bilprov.spec.explain import check, explain
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.readings import ERRATA, POINTS, READINGS, other_choices
from tests import vectors_dynamixel1, vectors_modbus_rtu, vectors_stk500v1
from tests.frame_vectors import RequestVector
from tests.support import ROOT
from tests.support.commands import command
from tests.vectors import ERRATA_IN_BYTES, ERRATUM_IDS, READING_IDS

PROTOCOL = load_protocol()


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
        assert frame.nearest is None or (frame.stops and frame.nearest.valid)
        assert bool(frame.differences) != frame.judgement.valid
        assert any(group.fault for group in frame.groups) <= (not frame.judgement.valid)


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


FOREIGN = [
    (name, one)
    for name, module in (
        ("modbus-rtu", vectors_modbus_rtu),
        ("stk500v1", vectors_stk500v1),
        ("dynamixel1", vectors_dynamixel1),
    )
    for one in module.REQUESTS
    if one.outcome not in ("bad-sync", "truncated") or name == "stk500v1"
]


@pytest.mark.parametrize(("name", "vector"), FOREIGN, ids=lambda value: str(value)[:40])
def test_every_bit_of_a_frame_of_any_layout_stands_in_one_group(
    name: str, vector: RequestVector
) -> None:
    protocol = load_protocol(name)
    (frame,) = explain(protocol, vector.frame).frames
    bits = "".join(group.bits for group in frame.groups)

    assert bits == "".join(f"{byte:08b}" for byte in vector.frame)
    assert frame.judgement.valid is (vector.outcome == "valid")
    assert all(group.meaning for group in frame.groups)
    faulty = [group for group in frame.groups if group.fault]
    assert bool(faulty) is (vector.outcome not in ("valid", "truncated"))
    assert frame.device == protocol.device


# -- errata and readings are complete, and the grammar alone finds the errata in the examples ------


def _named(text: str) -> set[str]:
    return set(re.findall(r"\bR-[a-z]+(?:-[a-z]+)*", text))


def test_every_reading_and_erratum_is_there_once() -> None:
    assert sorted(r.id for r in READINGS) == sorted(READING_IDS)
    assert [e.id for e in ERRATA] == list(ERRATUM_IDS)


def test_every_reading_that_a_file_names_exists() -> None:
    for folder in ("spec", "captures", "analyzer", "conformance"):
        for path in (ROOT / folder).rglob("*.py"):
            assert _named(path.read_text(encoding="utf-8")) <= set(READING_IDS), path


def test_the_grammar_finds_exactly_the_errata_that_show_in_the_bytes(protocol: Protocol) -> None:
    found = [
        (f.erratum.id if f.erratum else None, f.example.section, f.example.line, f.sent, f.meant)
        for f in check(protocol)
    ]

    assert found == list(ERRATA_IN_BYTES)


def test_the_errata_come_from_the_grammar_and_not_from_the_list(grammar_text: str) -> None:
    led_at_9 = load(grammar_text.replace('8: "LED"', '9: "LED"'))
    right_without_data = load(
        grammar_text.replace(
            '"strength" / Ranged(Byte, 0, 255) * "steering strength",\n        document="Höger"',
            'document="Höger"',
        ).replace('From("strength")),', "255),")
    )

    assert [f.erratum.id for f in check(led_at_9) if f.erratum] == ["E3"]
    # Right takes no data now; the byte after it is still one too many.
    assert right_without_data.by_id[4].length == 0
    (right, led) = check(right_without_data)
    assert right.meant == b"\x40"
    assert right.reason == "Right; 1 byte more in the line, read as a new header"
    assert led.meant == b"\x81\x02"


# -- open points -----------------------------------------------------------------------------------


SILENT = (None, "R-truncated-known")


@pytest.mark.parametrize(
    ("frame", "choices"),
    [
        ("20", []),
        ("11 7f", []),
        ("81 09", []),
        ("10", []),
        ("f0", []),
        ("f1 00", [(3, "R-unused-length"), (4, "R-unused-length")]),
        ("12 00 00", []),  # Speed takes every byte
        ("82 05 00", []),
        ("82 09 00", [(2, "R-competing-errors")]),
        ("11", [SILENT]),
        ("12 00", [(3, "R-truncated-long"), SILENT]),
        ("f1", [(4, "R-truncated-unused"), (3, "R-truncated-unused"), SILENT]),
    ],
)
def test_the_answers_that_another_reading_allows(
    protocol: Protocol, frame: str, choices: list[tuple[int | None, str]]
) -> None:
    others = other_choices(protocol, judge(protocol, bytes.fromhex(frame)))

    assert [(other.code, other.reading) for other in others] == choices


def test_each_point_belongs_to_a_reading_and_tells_its_choices_apart() -> None:
    for ident, point in POINTS.items():
        assert point.id == ident
        assert point.reading in READING_IDS
        assert len(point.choices) > 1
        assert len({choice.word for choice in point.choices}) == len(point.choices)
        assert not point.choices[0].option
        behaviours = [choice.does for choice in point.choices if choice.does is not None]
        assert len(set(behaviours)) == len(behaviours)


def test_one_point_decides_about_a_variable_after_a_frame() -> None:
    places = Counter((p.about, moment) for p in POINTS.values() for moment in p.moments)

    assert places
    assert max(places.values()) == 1
    assert all(bool(p.about) is bool(p.moments) for p in POINTS.values())


def test_the_help_of_allow_names_every_option() -> None:
    words = command("conform", "--help", COLUMNS="200").stdout.decode().split()
    told = {word.strip("│,.") for word in words}
    options = {choice.option for point in POINTS.values() for choice in point.choices}
    options |= {point.skipped for point in POINTS.values()}
    options -= {"", "version=VERSION"}  # of a version, the help names one

    assert options | {"version=1.0"} <= told
    assert len(options) == 4


def test_python_explains_an_answer_by_its_request() -> None:
    protocol = load_protocol("stk500v1")
    (one,) = api.explain(b"\x14\x03\x10", "device", protocol, b"\x41\x81\x20").responses
    names = [group.name for group in one.groups]
    assert (one.words, names) == ("OK value=3", ["insync", "value", "code"])
    with pytest.raises(ValueError, match="41 81 is not answered"):
        api.explain(b"\x14\x10", "device", protocol, b"\x41\x81")
