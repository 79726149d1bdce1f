"""What people read is free of the turns of phrase that CONTRIBUTING.md lists: pages and messages.

CONTRIBUTING.md lists each turn with what to write instead.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest

from bilprov.__main__ import COMMANDS
from tests.support import ROOT
from tests.support.commands import command
from tests.test_docs import PAGES

# Each pattern, with an example of it that CONTRIBUTING.md lists. Programs report, show, print and
# write; they do not talk.
TURNS = {
    r"tells?|told|telling": "tells, told",
    r"says?|said|saying": "says, said",
    r"read out of": "read out of",
    r"(ends?|ended|ending) (with|in) [0-3]\b(?! (ms|s|bytes?|frames?)\b)": "ends with 2",
    r"(a|an|the|each|every|its|one|no|of|few|many) looks?(?! (for|like)\b)(?!ed\b)": "a look",
    r"(one|an?) (object|line|row|message|bit|byte) an? (frame|case|line|byte|part)": (
        "one object a frame"
    ),
    r"anew": "anew",
    r"mend(s|ed|ing)?": "mends",
    r"some \d[\d,.]*": "some 8 minutes",
    r"(every|each|any) (other )?way out": "every way out",
    r"(would|is|are|could|will) else": "would else",
    r"held against": "held against",
    r"that there (is|are)": "all that there is",
    r"so (does|do) (it|every|each|the)": "so does every",
    r"(is|are) no (code|name|value|part|command|capture|row|number|file)s?": "is no code",
    r"heard on": "is heard on",
    r"goes wrong may": "what goes wrong may",
    r"next \w+ but one": "the next section but one",
    r"for the sake of": "for the sake of",
}
_ANY = re.compile(rf"\b(?:{'|'.join(TURNS)})\b", re.IGNORECASE)


def turns(text: str) -> list[str]:
    """The turns in a text that people read, each with some words around it."""
    plain = " ".join(text.split())
    return [plain[max(0, m.start() - 30) : m.end() + 30] for m in _ANY.finditer(plain)]


def prose(page: str) -> str:
    """The prose of a Markdown page: without code, and without what a program wrote."""
    text = re.sub(r"^<!-- .*?^<!-- .*?-->$", "", page, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^```\w*$.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`\n]*`", "`code`", text)


HEADING = "\n## Words\n"
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PROSE = {
    # `make torture` writes RELIABILITY.md.
    page.relative_to(ROOT).as_posix(): prose(page.read_text(encoding="utf-8").split(HEADING)[0])
    for page in PAGES
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


# -- help pages and messages ---


PACKAGES = ("analyzer", "captures", "conformance", "spec", "src")
# Turns of messages alone, each with an example; prose of pages may use them.
MESSAGE_TURNS = {
    r"otherwise than": "reads the document otherwise than the machine",
    r"(?<!there )(?:is|are) no (?!longer\b|more\b)\w+": "'x' is no number",
    r"what is whole|all that is whole": "all that is whole is shown",
    r"which is not this": "expected OK, which is not this",
    r"in \w+ looks|\d looks|looks? (?:that|of|at)": "looks that agree",
    r"go(?:es)? on looking": "go on looking",
    r"nothing shows": "nothing shows all rows",
    r"for want of": "for want of a port",
    r"cannot tell": "cannot tell",
    r"(?:is|are) wanted": "a value is wanted",
    r"is asked for": "is asked for twice",
}
# What scripts stand on: a line of `bilprov lab score`, and the reasons that captures hold.
KEPT = ("that can be told apart", "header says", "the device says", "expected is")


def message_turns(text: str) -> list[str]:
    """The turns in a help page or a message."""
    for words in KEPT:
        text = text.replace(words, "")
    plain = " ".join(text.split())
    found = (re.search(pattern, plain) for pattern in MESSAGE_TURNS)
    return turns(plain) + [match.group() for match in found if match]


def messages(source: str) -> Iterator[tuple[int, str]]:
    """The line and the text of each string with two words or more that is not a docstring.

    What an f-string inserts is left out. A piece of a template that is code is no message.
    """
    tree = ast.parse(source)
    pieces = {id(piece) for node in ast.walk(tree) for piece in _pieces(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            text = "".join(
                str(p.value) if isinstance(p, ast.Constant) else "X" for p in node.values
            )
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value
        else:
            continue
        if id(node) not in pieces and re.search(r"\w [\w(]", text):
            yield node.lineno, text


def _pieces(node: ast.AST) -> Iterator[ast.AST]:
    """The strings within a node that are no messages of their own: docstrings, parts of others."""
    if isinstance(node, ast.Expr):
        yield node.value
    elif isinstance(node, ast.JoinedStr):
        yield from node.values


@pytest.mark.parametrize("package", PACKAGES)
def test_a_message_is_in_plain_english(package: str) -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {turn}"
        for path in sorted((ROOT / package).rglob("*.py"))
        for line, text in messages(path.read_text(encoding="utf-8"))
        for turn in message_turns(text)
    ]

    assert found == []


def test_a_help_page_is_in_plain_english() -> None:
    found = {
        name: found
        for name in ("", *COMMANDS)
        if (found := message_turns(command(*name.split(), "--help").stdout.decode()))
    }

    assert found == {}


@pytest.mark.parametrize("pattern", MESSAGE_TURNS)
def test_a_turn_finds_its_example(pattern: str) -> None:
    assert message_turns(MESSAGE_TURNS[pattern])
