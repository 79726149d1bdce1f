"""`python -m benchmarks.torture`: what it says of each harm, its exit code, and the page."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.torture import __main__ as torture
from benchmarks.torture.harm import Harm, Progress, Row
from benchmarks.torture.harms import HARMS
from benchmarks.torture.page import page
from tests.support import ROOT


def harm(*wrong: str) -> Harm:
    def measure(runs: int, seed: int, progress: Progress) -> list[Row]:
        progress(runs)
        return [Row(f"a | b {seed}", runs, "1 of [2]\nlost", wrong)]

    return Harm("files", "files that are hurt", 7, measure)


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(torture, "PAGE", tmp_path / "page.md")
    return tmp_path / "page.md"


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
def test_a_harm_is_done_told_and_written_down(
    wrong: tuple[str, ...],
    code: int,
    held: str,
    monkeypatch: pytest.MonkeyPatch,
    written: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(monkeypatch, {"files": harm(*wrong)}, "--seed", "3", "--page") == code

    text = written.read_text()
    assert f"| a \\| b 3 | 7 | 1 of [2] lost | {held} |" in text
    assert "## Files that are hurt" in text
    assert "python -m benchmarks.torture files --runs 7 --seed 3" in text
    assert all(sentence in capsys.readouterr().out for sentence in wrong)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["x"], "no harm 'x', only files, more"),
        (["--runs", "0"], "--runs 0: one at least"),
    ],
)
def test_what_cannot_be_done_is_told(
    words: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    written: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, {"files": harm(), "more": harm()}, *words)

    assert stop.value.code == 2
    assert said in capsys.readouterr().err
    assert not written.exists()


def test_the_sections_of_other_harms_stay_as_they_are(
    monkeypatch: pytest.MonkeyPatch, written: Path
) -> None:
    first, second, gone = (Harm(what, what, 7, harm().measure) for what in ("one", "two", "old"))
    run(monkeypatch, {"two": second, "old": gone}, "--page")
    before = written.read_text()
    run(monkeypatch, {"one": first, "two": second}, "one", "--page", "--runs", "9")

    head, one, two = written.read_text().split("\n## ")
    assert before.startswith(f"{head}\n## {two}")
    assert one.startswith("One\n")
    assert "--runs 9" in one


def test_the_page_of_the_project_has_every_harm() -> None:
    text = (ROOT / "docs" / "RELIABILITY.md").read_text()

    assert [name for name in HARMS if f"benchmarks.torture {name} --runs" not in text] == []
    assert page([], text) == text
    assert "| **no** |" not in text
