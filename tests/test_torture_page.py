"""`python -m benchmarks.torture`: what it keeps of each harm, its exit code, and the page."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.torture import __main__ as torture
from benchmarks.torture.harm import Harm, Measured, Progress, Row
from benchmarks.torture.harms import HARMS
from benchmarks.torture.page import page
from tests.support import ROOT


def harm(*wrong: str) -> Harm:
    def measure(runs: int, seed: int, progress: Progress) -> list[Row]:
        progress(runs)
        return [Row(f"a | b {seed}", runs, "1 of [2]\nlost", wrong)]

    return Harm("files", "files that are hurt", 7, measure)


@pytest.fixture
def ended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(torture, "OUT", tmp_path / "out")
    monkeypatch.setattr(torture, "PAGE", tmp_path / "page.md")
    return tmp_path


def run(monkeypatch: pytest.MonkeyPatch, harms: dict[str, Harm], *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["torture", *words])
    HARMS.clear()
    HARMS.update(harms)
    return torture.main()


@pytest.fixture(autouse=True)
def _harms() -> Iterator[None]:
    kept = dict(HARMS)
    yield
    HARMS.clear()
    HARMS.update(kept)


@pytest.mark.parametrize(("wrong", "code", "held"), [((), 0, "yes"), (("lost!",), 1, "**no**")])
def test_a_harm_is_done_kept_and_written_down(
    wrong: tuple[str, ...],
    code: int,
    held: str,
    monkeypatch: pytest.MonkeyPatch,
    ended: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(monkeypatch, {"files": harm(*wrong)}, "--seed", "3", "--page") == code

    kept = Measured.from_json(json.loads((ended / "out" / "files.json").read_text()))
    assert kept.rows == (Row("a | b 3", 7, "1 of [2]\nlost", wrong),)
    text = (ended / "page.md").read_text()
    assert f"| a \\| b 3 | 7 | 1 of [2] lost | {held} |" in text
    assert "## Files that are hurt" in text
    assert "python -m benchmarks.torture files --runs 7 --seed 3" in text
    assert all(sentence in capsys.readouterr().out for sentence in wrong)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["x"], "no harm 'x', only files, more"),
        (["--runs", "0"], "--runs 0: one at least"),
        (["files", "--page"], "not done yet: more"),
    ],
)
def test_what_cannot_be_done_is_told(
    words: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    ended: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, {"files": harm(), "more": harm()}, *words)

    assert stop.value.code == 2
    assert said in capsys.readouterr().err
    assert not (ended / "page.md").exists()


def test_the_page_of_the_project_has_every_harm() -> None:
    text = (ROOT / "docs" / "RELIABILITY.md").read_text()

    assert [name for name in HARMS if f"benchmarks.torture {name} --runs" not in text] == []
    assert page([]).splitlines()[0] == text.splitlines()[0]
