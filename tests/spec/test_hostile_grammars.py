"""Hostile grammars: each ends in one short sentence, within bounded memory and work.

They are loaded as the grammar inside a capture is: it must first hold nothing but declarations. A
grammar that the user names is loaded without that; the same sentences come for it.
"""

from __future__ import annotations

import json

import pytest

from benchmarks.hostile_grammars import (
    BOMBS,
    SPEED,
    WRONG,
    bomb,
    embedded,
    mutated,
)
from bilprov.spec.protocol import GrammarError, load
from bilprov.spec.safe_grammar import NotDeclared
from tests.support.commands import process


def sentence(text: str, *, declared: bool = True) -> str:
    """What is said about a grammar that cannot be used: one line, short, and all of it prints."""
    with pytest.raises((NotDeclared, GrammarError)) as raised:
        (embedded if declared else load)(text)
    said = str(raised.value)
    assert said.isprintable()
    assert len(said) < 400
    return said


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_declaration_is_one_sentence(grammar_text: str, name: str) -> None:
    changes, piece = WRONG[name]

    assert piece in sentence(mutated(grammar_text, changes))


@pytest.mark.parametrize("name", WRONG)
def test_the_same_holds_for_a_grammar_that_the_user_names(grammar_text: str, name: str) -> None:
    text = mutated(grammar_text, WRONG[name][0])
    if "this(" not in text or "this(4294967296)" not in text:  # Python itself allows that
        sentence(text, declared=False)


# What only a grammar that runs can hold.
RUN = {
    "a time that is not a number": ({"stop_longest=100": 'stop_longest=float("nan")'}, "is nan"),
    "an infinite time": ({"stop_longest=100": 'stop_longest=float("inf")'}, "is inf"),
    "a number of pages": ({"stop_longest=100": "stop_longest=10**5000"}, "of 16610 bits"),
    "a factor of pages": ({"factor=-1": "factor=10**5000"}, "of 16610 bits"),
    "an error of pages": ({'NAME = "': 'raise ValueError("\\x1b[2J" * 9999)\nNAME = "'}, "x1b"),
    "a way out": ({'NAME = "': 'raise SystemExit(0)\nNAME = "'}, "SystemExit"),
    "a recursion": ({'NAME = "': '(f := lambda: f())()\nNAME = "'}, "RecursionError"),
    "a construct that reads nothing known": (
        {SPEED: '"speed" / Ranged(__import__("construct").Float32b, 0, 1)'},
        "must be a whole number",
    ),
    "prose of bytes": ({'"steering strength"': 'b"x"'}, "is b'x', allowed is a text"),
}


@pytest.mark.parametrize("name", RUN)
def test_a_grammar_that_runs_ends_in_a_sentence_too(grammar_text: str, name: str) -> None:
    changes, piece = RUN[name]

    assert piece in sentence(mutated(grammar_text, changes), declared=False)


def test_the_sentence_tells_the_line(grammar_text: str) -> None:
    line = 1 + grammar_text.splitlines().index("TIMING = Timing(")

    said = sentence(mutated(grammar_text, WRONG["a time that is a text"][0]))

    assert said == (
        "the grammar grammar cannot be used: Timing.truncation_timeout in ms is 'a', "
        f"allowed is a number (line {line})"
    )


def test_pythons_own_remarks_about_a_grammar_are_not_shown(
    grammar_text: str, recwarn: pytest.WarningsRecorder
) -> None:
    said = sentence(f"{grammar_text}\nX = 1('\\d')\n")

    assert "there is a Call" in said
    load(f'{grammar_text}\nX = "\\d"\n')
    assert not recwarn.list


MEMORY, SECONDS = 1 << 30, 30  # bytes of address space; of computing, for all of them

RUNNER = f"""
import json, resource, sys
resource.setrlimit(resource.RLIMIT_AS, ({MEMORY}, {MEMORY}))
resource.setrlimit(resource.RLIMIT_CPU, ({SECONDS}, {SECONDS}))
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import load
from bilprov.spec.safe_grammar import NotDeclared, require_declarations
said = []
for text in json.load(sys.stdin):
    try:
        require_declarations(text)
        load(text)
        said.append("")
    except (NotDeclared, UserError) as error:
        said.append(str(error))
json.dump(said, sys.stdout)
"""


@pytest.fixture(scope="module")
def bombs_said(grammar_text: str) -> dict[str, str]:
    """What is said about each bomb, by a process that has little memory and time."""
    texts = [bomb(grammar_text, name) for name in BOMBS]
    done = process(code=RUNNER, input=json.dumps(texts).encode())
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stderr == b""
    return dict(zip(BOMBS, json.loads(done.stdout), strict=True))


@pytest.mark.waits
@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_a_sentence_in_little_memory_and_time(
    bombs_said: dict[str, str], name: str
) -> None:
    said = bombs_said[name]

    assert said
    assert said.isprintable()
    assert len(said) < 400
    assert "MemoryError" not in said
