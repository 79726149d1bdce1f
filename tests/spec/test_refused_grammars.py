"""Grammars that are refused when they are loaded, each by one sentence with its line.

A paragraph of `refused_grammars.txt` is a grammar with one thing changed, or the base of those that
follow; the first characters of a line give its meaning:

    @ FILE, : TEXT     the base, a file or these lines; changes below are made for each row
    - TEXT, + TEXT     what is replaced, and what takes its place; several lines are one text
    ! SENTENCE         what is said; in place of a line's number stands that line of the grammar
    ? SENTENCE         what is said of it as part of a capture, where that is another sentence

The sentences are written by `pytest -n 0 --rewrite-transcripts`; `...` stands for anything.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from bilprov.spec.errors import UserError
from bilprov.spec.protocol import load
from bilprov.spec.safe_grammar import NotDeclared
from tests.support import ROOT
from tests.support.grammars import embedded, mutated

PAGE = Path(__file__).with_name("refused_grammars.txt")
PARTS = PAGE.read_text(encoding="utf-8").strip("\n").split("\n\n")


def changes(part: str) -> dict[str, str]:
    """What a paragraph replaces, by what takes its place."""
    pairs: list[tuple[list[str], list[str]]] = []
    for line in part.split("\n"):
        if line[:1] == "-":
            if not pairs or pairs[-1][1]:
                pairs.append(([], []))
            pairs[-1][0].append(line[2:])
        elif line[:1] == "+":
            pairs[-1][1].append(line[2:])
    return {"\n".join(old): "\n".join(new) for old, new in pairs}


def rows() -> dict[str, str]:
    """The text of the wrong grammar of each paragraph that is a row."""
    found: dict[str, str] = {}
    for part in PARTS:
        if part.startswith("@ "):
            file, *below = part.split("\n")
            base = "".join(f"{line[2:]}\n" for line in below if line.startswith(":"))
            base = base or (ROOT / file[2:]).read_text(encoding="utf-8")
            base = mutated(base, changes(part)) if changes(part) else base
        else:
            found[part] = mutated(base, changes(part))
    return found


ROWS = rows()


def sentence(text: str, loaded: Callable[[str], object]) -> str:
    """What is said about a grammar: one line, short, and all of it prints."""
    with pytest.raises((NotDeclared, UserError)) as raised:
        loaded(text)
    said = str(raised.value).removeprefix("the grammar grammar cannot be used: ")
    assert said.isprintable()
    assert len(said) < 400
    lines = ["", *text.splitlines()]
    return re.sub(r"\bline (\d+)", lambda found: f"line `{lines[int(found[1])].strip()}`", said)


@pytest.mark.parametrize("part", ROWS, ids=lambda part: part.partition("! ")[2])
def test_a_wrong_grammar_is_refused_in_one_sentence(part: str, pytestconfig: pytest.Config) -> None:
    text = ROWS[part]
    said = list(dict.fromkeys(sentence(text, loaded) for loaded in (load, embedded)))
    expected = [line for line in part.split("\n") if line[:1] in ("!", "?")]
    found = [f"{mark} {one}" for mark, one in zip("!?", said, strict=False)]
    if pytestconfig.getoption("--rewrite-transcripts"):
        rest = [line for line in part.split("\n") if line not in expected]
        whole = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(whole.replace(part, "\n".join([*rest, *found])), encoding="utf-8")
        return
    pattern = re.escape("\n".join(expected)).replace(re.escape("..."), ".*")
    assert re.fullmatch(pattern, "\n".join(found)), found
