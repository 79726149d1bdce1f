"""What people read is free of the turns of phrase that CONTRIBUTING.md lists."""

from __future__ import annotations

import re

import pytest

from tests.support import ROOT
from tests.support.pages import pages
from tests.support.plain_english import TURNS, prose, turns

HEADING = "\n## Words\n"
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PROSE = {
    # `make torture` writes RELIABILITY.md.
    page.relative_to(ROOT).as_posix(): prose(page.read_text(encoding="utf-8").split(HEADING)[0])
    for page in pages()
    if page.name != "RELIABILITY.md"
}


@pytest.mark.parametrize("page", PROSE)
def test_a_page_is_in_plain_english(page: str) -> None:
    assert turns(PROSE[page]) == []


def test_contributing_lists_each_turn_with_what_to_write_instead() -> None:
    rows = re.findall(r"^\| (.+?) \| (.+?) \|$", CONTRIBUTING.split(HEADING)[1], re.MULTILINE)[1:]

    assert [listed for listed, _ in rows] == list(TURNS.values())
    for (listed, instead), pattern in zip(rows, TURNS, strict=True):
        assert re.search(rf"\b(?:{pattern})\b", listed), listed
        assert turns(instead) == [], instead
