"""ARCHITECTURE.md and its picture are what the code says; every file that documents name exists."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from docs.architecture import (
    BEGIN,
    PLACES,
    Box,
    arrow,
    drawn,
    imported,
    package_of,
    picture,
    promise,
    reduced,
    table,
)
from tests.support import ROOT
from tests.test_layers import ROOMS

DOCUMENTS = ("docs/ARCHITECTURE.md", "CONTRIBUTING.md")


def _named_paths(document: str) -> set[Path]:
    """Links, and what stands in backticks and looks like a file or a folder."""
    text = (ROOT / document).read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^):]+)\)", text)
    quoted = re.findall(r"`([\w.-]+(?:/[\w.-]+)*(?:/|\.[a-z]+))`", text)
    return {(ROOT / document).parent / link for link in links} | {ROOT / path for path in quoted}


def test_document_and_picture_are_what_the_code_says() -> None:
    for file, text in drawn(ROOT / "docs").items():
        assert file.read_text(encoding="utf-8") == text, (
            f"{file.name} is out of date: make pictures"
        )


def test_what_was_changed_by_hand_in_the_table_is_written_anew(tmp_path: Path) -> None:
    document = (ROOT / DOCUMENTS[0]).read_text(encoding="utf-8")
    stale = document.replace(promise("spec"), "Something else.")
    (tmp_path / "ARCHITECTURE.md").write_text(stale, encoding="utf-8")

    assert stale != document
    assert drawn(tmp_path)[tmp_path / "ARCHITECTURE.md"] == document
    assert document.count(BEGIN) == 1


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_file_that_a_document_names_exists(document: str) -> None:
    named = _named_paths(document)

    assert len(named) > 4
    assert [path for path in named if not path.exists()] == []


def test_every_package_has_a_row_and_a_box() -> None:
    folders = {file.parent.relative_to(ROOT).as_posix() for file in ROOT.glob("*/*/__init__.py")}
    ours = {path for path in folders if path.split("/")[0] in {row[0] for row in ROOMS}}

    assert [path for path in sorted(ours) if f"| [{path}/](" not in table()] == []
    assert set(PLACES) == {names[0] for names in ROOMS}


@pytest.mark.slow
def test_every_room_stands_above_or_beside_what_it_imports() -> None:
    rows = {rank: PLACES[names[0]].row for rank, names in enumerate(ROOMS)}
    pairs = [
        (rank, other)
        for rank, others in imported().items()
        for other in others
        if package_of(rank) == package_of(other)
    ]

    assert len(pairs) > 30
    assert [(ROOMS[a], ROOMS[b]) for a, b in pairs if rows[a] > rows[b]] == []


def test_no_text_leaves_its_box() -> None:
    """By the width that a wide font gives a letter on the average."""
    width = {"title": 9.4, "note": 7.4}
    name = "{http://www.w3.org/2000/svg}"
    box: dict[str, str] = {}
    for element in ElementTree.fromstring(picture()):
        if element.get("class") == "box":
            box = element.attrib
        elif element.tag == f"{name}text" and element.get("class") in width:
            wide = len(element.text or "") * width[element.attrib["class"]]
            assert wide <= float(box["width"]), element.text


def test_an_import_that_follows_from_others_has_no_arrow() -> None:
    graph = {"top": {"middle", "ground"}, "middle": {"ground"}, "ground": set[str]()}

    assert reduced(graph) == {"top": {"middle"}, "middle": {"ground"}, "ground": set()}


def test_an_arrow_goes_straight_down_where_the_way_is_free_and_around_a_box_that_is_in_it() -> None:
    upper, lower = Box(0, 0, 100, 20), Box(0, 100, 100, 20)
    aside, in_the_way = Box(110, 50, 40, 20), Box(40, 50, 40, 20)

    assert 'd="M50 20L50 100"' in arrow(upper, lower, [aside])
    assert 'd="M100 10C112 10 112 110 100 110"' in arrow(upper, lower, [in_the_way])


def test_an_arrow_within_a_row_joins_the_sides_that_face_each_other() -> None:
    left, right = Box(0, 0, 100, 20), Box(130, 0, 100, 20)

    assert 'd="M100 10H130"' in arrow(left, right, [])
    assert 'd="M130 10H100"' in arrow(right, left, [])
