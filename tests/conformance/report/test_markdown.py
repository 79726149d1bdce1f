"""The Markdown summary, read by a public parser: its content, and that foreign text is inert."""

from __future__ import annotations

import re

import pytest
from markdown_it import MarkdownIt
from markdown_it.token import Token
from msgspec.structs import replace

from bilprov.captures.text import escape_controls
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.markdown import as_markdown, code, prose
from bilprov.conformance.report.run_report import Covered
from bilprov.spec.protocol import Protocol
from tests.support.reports import EVIL, a_case, every_verdict, hostile

PARSER = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])


def tokens(text: str) -> list[Token]:
    return [token for outer in PARSER.parse(text) for token in (outer, *(outer.children or ()))]


def table(text: str) -> list[list[str]]:
    """The cells of the table, row by row, as a reader sees them."""
    found: list[list[str]] = []
    inside = False
    for token in PARSER.parse(text):
        if token.type == "tr_open":
            found.append([])
        elif token.type in ("td_open", "th_open", "td_close", "th_close"):
            inside = token.nesting == 1
        elif token.type == "inline" and inside:
            found[-1].append("".join(child.content for child in token.children or ()))
    return found


def test_what_was_not_judged_is_told_by_reason(protocol: Protocol) -> None:
    results = [a_case(f"x/{n}", Verdict.INCONCLUSIVE, "not observable") for n in range(30)]
    results += [a_case("y/1", Verdict.INCONCLUSIVE, "flaky")]
    text = as_markdown([replace(every_verdict(protocol), results=tuple(results), exit=3)], protocol)

    assert "- 30 cases, `x/0` is the first: not observable" in text
    assert "- 1 case, `y/1` is the first: flaky" in text


def test_it_stays_short_whatever_came(protocol: Protocol) -> None:
    words = "<|`" * 5000
    results = [
        replace(a_case(f"{n}{words}/{words}", verdict, words), reproduce=words, clause=words)
        for n in range(300)
        for verdict in Verdict
    ]
    coverage = {f"{n}{words}": Covered(n, 300) for n in range(300)}
    report = replace(
        every_verdict(protocol), results=tuple(results), device=words, coverage=coverage
    )

    text = as_markdown([report] * 30, protocol)

    assert len(text.encode()) < 1 << 20
    assert "reports are left out" in text
    alone = as_markdown([report], protocol)
    assert len(alone) < 200_000
    assert "### Coverage" in alone


@pytest.mark.parametrize("evil", EVIL)
def test_any_foreign_text_is_text(protocol: Protocol, evil: str) -> None:
    text = as_markdown([hostile(protocol, evil)], protocol)
    found = tokens(text)

    kinds = {token.type for token in found}
    assert not kinds & {"link_open", "image", "html_block", "s_open", "em_open", "blockquote_open"}
    assert {t.content for t in found if t.type == "html_inline"} <= {"<!-- -->"}
    # Headings and lists are ours alone.
    headings = [token for token in found if token.type == "heading_open"]
    assert len(headings) == 4
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028\u202e\ud800-\udfff]", text)
    assert {len(row) for row in table(text)} == {3}


@pytest.mark.parametrize(
    "evil", [*EVIL, "# x", "- x", "1. x", "12) x", "+ x", "> x", "    x", "==="]
)
def test_prose_reads_as_it_was(evil: str) -> None:
    words = prose(escape_controls(evil))
    for begin in ("", "- "):
        text = f"{begin}{words}"
        outer = [t.type for t in PARSER.parse(text) if t.type.endswith("_open")]
        assert outer == (["bullet_list_open", "list_item_open"] if begin else []) + [
            "paragraph_open"
        ]
    inner = [t for t in tokens(words) if t.type not in ("html_inline", "paragraph_open")]
    assert {t.type for t in inner} <= {"inline", "text", "text_special", "paragraph_close"}


@pytest.mark.parametrize("text", ["a", "`", "``a`", "a ` b", "|", " ", "\\", "a\\|b", "` `` ```"])
def test_code_reads_as_it_was(text: str) -> None:
    rows = table(f"| x | y |\n|---|---|\n| {code(text)} | z |\n")

    assert [cell.strip() for cell in rows[1]] == [text.strip(), "z"]


def test_nobody_is_mentioned_and_nothing_becomes_an_address() -> None:
    assert prose("@all") == "@<!-- -->all"
    assert prose("see www.x.org, http://y") == "see www<!-- -->.x.org, http://<!-- -->y"
