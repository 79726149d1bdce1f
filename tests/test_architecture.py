"""ARCHITECTURE.md and its picture are what the code says; every file that documents name exists."""

from __future__ import annotations

import re

import pytest

from docs.architecture import PLACES, drawn, table
from tests.support import ROOT
from tests.test_layers import ROOMS


@pytest.mark.slow
def test_document_and_picture_are_what_the_code_says() -> None:
    stale = [file.name for file, text in drawn(ROOT / "docs").items() if file.read_text() != text]

    assert stale == [], "make pictures"


@pytest.mark.parametrize("document", ["docs/ARCHITECTURE.md", "CONTRIBUTING.md"])
def test_every_file_that_a_document_names_in_backticks_exists(document: str) -> None:
    text = (ROOT / document).read_text(encoding="utf-8")
    named = re.findall(r"`([\w.-]+(?:/[\w.-]+)*(?:/|\.[a-z]+))`", text)

    assert len(named) > 4
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_every_package_has_a_row_and_a_box() -> None:
    folders = {file.parent.relative_to(ROOT).as_posix() for file in ROOT.glob("*/*/__init__.py")}
    ours = {path for path in folders if path.split("/")[0] in {row[0] for row in ROOMS}}

    assert [path for path in sorted(ours) if f"| [{path}/](" not in table()] == []
    assert set(PLACES) == {names[0] for names in ROOMS}
