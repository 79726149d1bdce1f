"""Cuts the text of a filter into tokens, and reads numbers, quoted text and bytes out of them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from bilprov.analyzer.filters.parts import FilterError, Number, Octets, Quoted
from bilprov.captures.text import printable


class Token(NamedTuple):
    """A piece of the text; `kind` is the name of a group of _TOKEN, or empty at the end."""

    kind: str
    text: str
    start: int
    end: int


_TOKEN = re.compile(
    r"""
      (?P<moment> \d{4}-\d\d-\d\d
                  (?: [T ] \d\d?:\d\d (?: :\d\d (?:\.\d+)? )? (?: Z | [+-]\d\d:?\d\d )? )? (?![\w:])
                | \d\d? : \d\d (?: :\d\d (?:\.\d+)? )? (?![\w:]) )
    | (?P<sign>   \.\. | [=!<>]= | && | \|\| | [<>&!(){}\[\],] )
    | (?P<number> [-+]? (?: 0[xX][\da-fA-F_]+ | 0[bB][01_]+
                          | (?: \d[\d_]* (?:\.\d+)? | \.\d+ ) (?: [eE][-+]?\d+ )? )
                  (?: (?P<unit> [^\W\d]\w* ) | \s+ (?P<apart> us|µs|μs|ms|s ) \b )? )
    | (?P<text>   '(?:[^'\\]|\\.)*' | "(?:[^"\\]|\\.)*" )
    | (?P<word>   [^\W\d]\w* (?: \.[^\W\d]\w* )* )
    """,
    re.VERBOSE | re.DOTALL,
)
_BLANK = re.compile(r"\s*")
_WRONG = re.compile(r"[^\w\s(){}\[\],'\"]+|.", re.DOTALL)
_OCTETS = re.compile(r"(?:0[xX])?(?:[\da-fA-F]{2})+(?:(?:\s+|[:-])(?:[\da-fA-F]{2})+)*(?!\w)")
_HEX = re.compile(r"[\da-fA-F]{2}")
_ESCAPE = re.compile(r"\\(.)", re.DOTALL)

_INSTEAD = {
    "=": "==",
    "|": "||",
    "is": "==",
    "eq": "==",
    "ne": "!=",
    "lt": "<",
    "le": "<=",
    "gt": ">",
    "ge": ">=",
    "matches": "contains",
}


def tokens(text: str) -> Iterator[Token]:
    """Yield the pieces of a text, and one of no kind at its end. Raises FilterError."""
    at = 0
    while True:
        token = token_at(text, at)
        yield token
        if not token.kind:
            return
        at = token.end


def token_at(text: str, at: int) -> Token:
    """The piece at this place, or behind the blanks there. Raises FilterError."""
    blank = _BLANK.match(text, at)
    at = blank.end() if blank else at
    if at == len(text):
        return Token("", "", at, at)
    match = _TOKEN.match(text, at)
    if match is not None:
        return Token(match.lastgroup or "", match[0], match.start(), match.end())
    if text[at] in "'\"":
        raise FilterError("this quote is never closed", at, len(text))
    wrong = _WRONG.match(text, at)
    piece = wrong[0] if wrong else ""
    why = instead_of(piece) or "cannot be part of a filter"
    raise FilterError(f"{printable(piece)!r} {why}", at, at + len(piece))


def instead_of(piece: str) -> str:
    """The end of a sentence about another language's sign or word for one; empty for all else."""
    meant = _INSTEAD.get(piece.lower())
    return f"is not a sign here, did you mean {meant}?" if meant else ""


def number(token: Token) -> Number:
    """The number in a token, apart from its unit."""
    match = _TOKEN.match(token.text)
    unit = (match["unit"] or match["apart"] or "") if match else ""
    return Number(token.start, token.end, token.text.removesuffix(unit).rstrip(), unit)


def quoted(token: Token) -> Quoted:
    """The text of a token in quotes; a backslash goes before a quote or a backslash.

    Raises FilterError for any other escape, which would not be what it looks like.
    """
    inner = token.text[1:-1]
    for escape in _ESCAPE.finditer(inner):
        if escape[1] not in "\\'\"":
            at = token.start + 1 + escape.start()
            why = "means nothing here; a backslash goes before a quote or a backslash"
            raise FilterError(f"{printable(escape[0])!r} {why}", at, at + 2)
    return Quoted(token.start, token.end, _ESCAPE.sub(r"\1", inner))


def octets_at(text: str, token: Token) -> Octets:
    """The bytes that begin with a token, in hex without quotes. Raises FilterError."""
    match = _OCTETS.match(text, token.start)
    if match is None:
        piece = printable(token.text.split()[0])
        why = "is not hex with two digits for each byte; bytes are written like 05 or 11 ff"
        raise FilterError(f"{piece!r} {why}", token.start, token.end)
    return Octets(match.start(), match.end(), _bytes(match[0]))


def octets_of(text: str) -> bytes | None:
    """The bytes that a text has in hex (`11 ff`, `0x11ff`, `11:ff`), or None if it is not hex."""
    text = text.strip()
    return _bytes(text) if not text or _OCTETS.fullmatch(text) else None


def _bytes(text: str) -> bytes:
    return bytes.fromhex("".join(_HEX.findall(text.lower().removeprefix("0x"))))
