"""The pieces of a filter's text: cuts the text into tokens, reads them; and FilterError."""

from __future__ import annotations

import re
from typing import NamedTuple

from bilprov.captures.text import printable
from bilprov.spec.errors import UserError


class FilterError(UserError, ValueError):
    """The text is no valid filter.

    The message is one sentence that begins with the column; `sentence` is without it. `column`
    (from 1) and `length` are the part of the text that it is about.
    """

    def __init__(self, sentence: str, start: int = 0, end: int = 0) -> None:
        self.sentence = sentence
        self.column = start + 1
        self.length = max(1, end - start)
        super().__init__(f"filter column {self.column}: {sentence}")


class Part(NamedTuple):
    """A piece of the text, which stands from `start` up to, not including, `end`.

    Its `kind` is one of

    - `word`, `quoted`, `moment` (a time of day or a date), `bytes` (in hex): a value in `text`
    - `number`: as it is written in `text`; its unit, if there is one, is its part
    - `item`: one byte of a word, `data[0]`; the word and the number
    - `bits`: the two of `rgb & 4`; `range`: its two ends; `set`: its values and ranges
    - `sign`: what compares, joins or closes, in `text`; `unit`; and an empty kind at the end
    - `compared`: operands with signs between them; `and`, `or`, `not`: conditions
    """

    kind: str
    start: int
    end: int
    text: str = ""
    parts: tuple[Part, ...] = ()


_TOKEN = re.compile(
    r"""\s*(?:
      (?P<moment> \d{4}-\d\d-\d\d
                  (?: [T ] \d\d?:\d\d (?: :\d\d (?:\.\d+)? )? (?: Z | [+-]\d\d:?\d\d )? )? (?![\w:])
                | \d\d? : \d\d (?: :\d\d (?:\.\d+)? )? (?![\w:]) )
    | (?P<sign>   \.\. | [=!<>]= | && | \|\| | [<>&!(){}\[\],] )
    | (?P<number> [-+]? (?: 0[xX][\da-fA-F_]+ | 0[bB][01_]+
                          | (?: \d[\d_]* (?:\.\d+)? | \.\d+ ) (?: [eE][-+]?\d+ )? ) )
                  (?: (?P<unit> [^\W\d]\w* ) | \s+ (?P<apart> us|µs|μs|ms|s ) \b )?
    | (?P<quoted> '(?:[^'\\]|\\.)*' | "(?:[^"\\]|\\.)*" )
    | (?P<word>   [^\W\d]\w* (?: \.[^\W\d]\w* )* )
    | (?P<end>    $ )
    | (?P<wrong>  [^\w\s(){}\[\],'\"]+ | . )
    )""",
    re.VERBOSE | re.DOTALL,
)
_OCTETS = re.compile(r"(?:0[xX])?(?:[\da-fA-F]{2})+(?:(?:\s+|[:-])(?:[\da-fA-F]{2})+)*(?!\w)")
_HEX = re.compile(r"[\da-fA-F]{2}")
_ESCAPE = re.compile(r"\\(.)", re.DOTALL)

_INSTEAD = {"=": "==", "is": "==", "eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">"}
_INSTEAD |= {"ge": ">=", "|": "||", "matches": "contains"}


def token_at(text: str, at: int) -> Part:
    """The piece at this place, or behind the blanks there. Raises FilterError."""
    match = _TOKEN.match(text, at)
    assert match is not None
    for kind in ("moment", "sign", "number", "quoted", "word"):
        if match[kind] is not None:
            unit = next((name for name in ("unit", "apart") if match[name]), None)
            parts = (Part("unit", *match.span(unit), match[unit]),) if unit else ()
            return Part(kind, match.start(kind), match.end(), match[kind], parts)
    start, end = match.span("wrong")
    if match["wrong"] is None:
        return Part("", len(text), len(text))
    if text[start] in "'\"":
        raise FilterError("this quote is never closed", start, len(text))
    why = instead_of(match["wrong"]) or "cannot be part of a filter"
    raise FilterError(f"{printable(match['wrong'])!r} {why}", start, end)


def instead_of(piece: str) -> str:
    """The end of a sentence about another language's sign or word for one; empty for all else."""
    meant = _INSTEAD.get(piece.lower())
    return f"is not a sign here, did you mean {meant}?" if meant else ""


def unquoted(token: Part) -> Part:
    """The text of a token in quotes; a backslash goes before a quote or a backslash.

    Raises FilterError for any other escape, which would not be what it looks like.
    """
    inner = token.text[1:-1]
    for escape in _ESCAPE.finditer(inner):
        if escape[1] not in "\\'\"":
            at = token.start + 1 + escape.start()
            why = "means nothing here; a backslash goes before a quote or a backslash"
            raise FilterError(f"{printable(escape[0])!r} {why}", at, at + 2)
    return token._replace(text=_ESCAPE.sub(r"\1", inner))


def octets_at(text: str, token: Part) -> Part:
    """The bytes that begin with a token, in hex without quotes. Raises FilterError."""
    match = _OCTETS.match(text, token.start)
    if match is None:
        piece = printable(text[token.start : token.end].split()[0])
        why = "is not hex with two digits for each byte; bytes are written like 05 or 11 ff"
        raise FilterError(f"{piece!r} {why}", token.start, token.end)
    return Part("bytes", match.start(), match.end(), _bytes(match[0]).hex(" "))


def octets_of(text: str) -> bytes | None:
    """The bytes that a text has in hex (`11 ff`, `0x11ff`, `11:ff`), or None if it is not hex."""
    text = text.strip()
    return _bytes(text) if not text or _OCTETS.fullmatch(text) else None


def _bytes(text: str) -> bytes:
    return bytes.fromhex("".join(_HEX.findall(text.lower().removeprefix("0x"))))
