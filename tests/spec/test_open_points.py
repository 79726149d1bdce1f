"""Open points: the table is sound, and says which other answers to a frame are legal."""

from __future__ import annotations

from collections import Counter

import pytest

from bilprov.spec.codec import judge
from bilprov.spec.open_points import other_choices
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS
from tests.support.commands import command
from tests.vectors import READING_IDS

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
