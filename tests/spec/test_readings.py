"""Errata and readings are complete, and the grammar alone finds the errata in the examples."""

from __future__ import annotations

import re
from collections import Counter

import pytest

from bilprov.spec.codec import judge
from bilprov.spec.explain import check
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.readings import ERRATA, POINTS, READINGS, other_choices
from tests.support import ROOT
from tests.support.commands import command
from tests.vectors import ERRATA_IN_BYTES, ERRATUM_IDS, READING_IDS


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
