"""Hostile texts, and what holds of each kind of surface that may show one."""

from __future__ import annotations

import csv
import io
import re
from html.parser import HTMLParser

HOSTILE = {
    "terminal": "\x1b[2J\x1b]0;owned\x07\x9b31m\x90q\x9c\x08\r\x7f",
    "direction": "\u202e\u2066abc\u2069\u200b\u200f\ufeff\U000e0041",
    "lines": "a\nb\r\nc\x0b\x0cd\x85e\u2028f\u2029g",
    "markup": "[/x][link=file:///etc/passwd]y[/link] [bold]%s {0} ${7*7}",
    "html": "</script><script>hit()</script><img src=x onerror=hit()>' onload='hit()\" x=\"",
    "xml": "]]><!-- --><?php ?><a>&amp;&#0;\ufffe",
    "markdown": "| `x` ```\n# h\n[a](javascript:hit()) ![b](http://e.example/p.png) <b>",
    "formula": "=cmd|'/c calc'!A1",
    "formulas": "@SUM(1)\t+1\r-1",
    "shell": "$(touch owned)`touch owned`;touch owned|\"'\\",
    "code": '*/ int hit(void); /* ]] os.execute("x") --[[ """ ??/',
}
"""What would do something on a surface that takes it as it is, by what it is aimed at."""
NUL = "a\0b"
BROKEN = "a\udc9bb"  # what Python makes of a byte that is no UTF-8
TAME = "tame"


def seen(shown: bytes) -> str:
    """What a terminal shows, of which every character must print. Colours of ours are left out."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", shown.decode("utf-8"))
    unseen = {character for character in text if not character.isprintable()} - {"\n"}
    assert not unseen, (unseen, text[:2000])
    return text


class Seen(HTMLParser):
    """The elements of a page and their attributes, as a parser finds them, with its comments."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_comment(self, data: str) -> None:
        self.elements.append(("comment", {}))

    def handle_pi(self, data: str) -> None:
        self.elements.append(("instruction", {}))


def html_elements(page: bytes) -> set[tuple[str, ...]]:
    """The kinds of elements of a page, each with the names of its attributes."""
    text = page.decode("utf-8")
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]", text)
    return {(tag, *attributes) for tag, attributes in Seen(text).elements}


def csv_cells(table: bytes) -> list[list[str]]:
    """The cells of a table, none of which is a formula or does not print."""
    rows = list(csv.reader(io.StringIO(table.decode("utf-8"), newline=""), strict=True))
    for cell in (cell for row in rows for cell in row):
        assert cell.isprintable(), cell
        number = re.fullmatch(r"[-+]?[0-9.]+(e[-+]?\d+)?", cell)
        assert number or not cell.startswith(("=", "+", "-", "@", "\t", "\r")), cell
    assert len({len(row) for row in rows}) == 1
    return rows


def c_lines(text: str) -> list[list[str]]:
    """The lines of C without its comments, word by word. No comment begins in another one."""
    text = text.replace("??/", "\\").replace("\\\n", "")
    for comment in re.findall(r"/\*.*?\*/", text, re.DOTALL):
        assert "/*" not in comment[2:], comment
    lines = re.sub(r"/\*.*?\*/", " ", text, flags=re.DOTALL).splitlines()
    return [words for line in lines if (words := line.split())]


_LUA = re.compile(
    r"--\[(=*)\[.*?\]\1\]|--[^\n]*"  # comments
    r"|\[(=*)\[.*?\]\2\]|\"(?:\\.|[^\"\\\n])*\"|'(?:\\.|[^'\\\n])*'"  # strings
    r"|\w+|\s+|[^\w\s]",
    re.DOTALL,
)


def lua_tokens(text: str) -> list[str]:
    """Lua without its comments, word by word, and with every string empty."""
    words = [found[0] for found in _LUA.finditer(text)]
    return [
        '""' if word[0] in "\"'" or word.startswith(("[[", "[=")) else word
        for word in words
        if not word.startswith("--") and not word.isspace()
    ]
