"""The measurements that the Makefile starts: each runs, holds at a small size, and sees a fault."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from benchmarks import captures
from benchmarks.bench import WORKS, measured
from benchmarks.mutants import ROOMS, draw
from benchmarks.report import as_markdown, between_markers, machine
from benchmarks.setting import Setting, Sizes, Work
from benchmarks.torture import changes
from benchmarks.torture.guard import watched
from benchmarks.torture.harm import Harm, Row
from benchmarks.torture.harms import HARMS, page
from tests.support import ROOT

# -- the bench ------------------------------------------------------------------------------------

TINY = Sizes(60_000, 2_000, 500, 1, 20_000, 0.5, 20_000, 0.3, 0.5, 20, 1)


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.waits
@pytest.mark.parametrize("work", WORKS, ids=lambda work: work.name)
def test_a_row_is_measured_beside_its_peers_which_give_the_same_results(
    work: Work, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(captures, "_KEPT", tmp_path)

    row = measured(Setting(tmp_path, TINY), work)

    assert row.ours, row.note
    assert row.goals
    table = as_markdown([row], machine())
    assert between_markers("<!-- bench -->old<!-- /bench -->", table).count(work.words) == 1


# -- mutants --------------------------------------------------------------------------------------


@pytest.mark.sample(2)
@pytest.mark.slow
@pytest.mark.parametrize("room", ROOMS)
def test_mutants_of_a_room_are_other_python_on_as_many_lines(room: str) -> None:
    drawn = draw(ROOT, room, 5, 7)

    assert len(set(drawn)) == 5
    for mutation in drawn:
        source = (ROOT / mutation.file).read_bytes()
        mutated = mutation.applied(source)
        assert ast.dump(ast.parse(mutated)) != ast.dump(ast.parse(source))
        assert mutated.count(b"\n") == source.count(b"\n")
    assert all((ROOT / name).exists() for name in ROOMS[room][1])


# -- captures that are damaged ---------------------------------------------------------------------


@pytest.mark.parametrize("path", changes.CORPUS, ids=lambda path: path.name)
@pytest.mark.parametrize("use", changes.USES)
def test_what_was_once_failed_on_fails_no_more(use: str, path: Path) -> None:
    with watched():
        assert changes.used(use, path.read_bytes()) in (True, False)


# -- torture --------------------------------------------------------------------------------------

FEW = {
    "damage": 160,
    "changes": 140,
    "hostile": 1,
    "kills": 3,
    "exits": 2,
    "signals": 2,
    "unplugs": 1,
}


@pytest.mark.slow
@pytest.mark.waits
@pytest.mark.sample(1)
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", FEW)
def test_a_harm_is_held(name: str) -> None:
    assert [one for row in HARMS[name].measure(FEW[name], 1) for one in row.wrong] == []


def test_the_page_has_every_harm_and_none_that_lost_what_may_not_be_lost() -> None:
    text = (ROOT / "docs" / "RELIABILITY.md").read_text()

    assert [name for name in HARMS if f"benchmarks.torture {name} --runs" not in text] == []
    assert page({}, text) == text
    assert "| **no** |" not in text
    lost = Harm("x", "files", 7, lambda *_: []).section([Row("a | b", 7, "[2]\nx", ("!",))], "", 3)
    assert "| a \\| b | 7 | [2] x | **no** |" in lost
