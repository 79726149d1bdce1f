"""Parses the text of a filter into parts that know their columns. Knows no protocol.

The parser is the kit's own: it also tells what may come next at a cursor.

    filter     = condition ("or" condition)*      "and" binds closer; && and || are the same
    condition  = ("not" | "!") condition | comparison
    comparison = operand (sign operand)*          100 < speed <= 200 is two comparisons
    sign       = == != < <= > >= ["not"] in | ["not"] contains
    operand    = primary ("&" primary)*           behind "in": a range or a set
    primary    = name | name[number] | number [unit] | moment | "text" | bytes | (filter)
    set        = operands and ranges with commas between, in {}, () or []
    range      = primary .. primary
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from contextlib import suppress
from functools import partial
from typing import NamedTuple, NoReturn

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

    @property
    def shown(self) -> str:
        """The part as it was written, or empty for what is longer than a value."""
        match self.kind, self.parts:
            case "item", (of, index):
                return f"{of.text}[{index.text}]"
            case "bits", (left, right):
                return f"{left.shown} & {right.shown}"
            case "number", (unit,):
                return printable(self.text + unit.text)
        return printable(self.text)


TEXTS = ("word", "quoted")
"""The kinds of parts that are text, with or without quotes."""


def refuse(part: Part, sentence: str) -> NoReturn:
    """Raise FilterError with a sentence about a part."""
    raise FilterError(sentence, part.start, part.end)


def refuse_part(part: Part, rest: str) -> NoReturn:
    """Raise FilterError with a sentence that begins with the part itself."""
    refuse(part, f"{part.shown!r} {rest}" if part.shown else f"this {rest}")


_TOKEN = re.compile(
    r"""\s*(?:
      (?P<moment> \d{4}-\d\d-\d\d
                  (?: [T ] \d\d?:\d\d (?: :\d\d (?:\.\d+)? )? (?: Z | [+-]\d\d:?\d\d )? )? (?![\w:])
                | \d\d? : \d\d (?: :\d\d (?:\.\d+)? )? (?![\w:]) )
    | (?P<sign>   \.\. | [=!<>]= | && | \|\| | [<>&!(){}\[\],] )
    | (?P<number> [-+]? (?: 0[xX]_*[\da-fA-F][\da-fA-F_]* | 0[bB]_*[01][01_]*
                          | (?: \d[\d_]* (?:\.\d+)? | \.\d+ ) (?: [eE][-+]?\d+ )? ) )
                  (?: (?= \S | \s+ (?: us|µs|μs|ms|s ) \b ) \s* (?P<unit> [^\W\d]\w* ) )?
    | (?P<quoted> '[^']*' | "[^"]*" )
    | (?P<word>   [^\W\d]\w* (?: \.[^\W\d]\w* )* )
    | (?P<end>    $ )
    | (?P<wrong>  [^\w\s(){}\[\],'\"]+ | . )
    )""",
    re.VERBOSE | re.DOTALL,
)
_OCTETS = re.compile(r"(?:0[xX])?(?:[\da-fA-F]{2})+(?:(?:\s+|[:-])(?:[\da-fA-F]{2})+)*(?!\w)")
_HEX = re.compile(r"[\da-fA-F]{2}")

_INSTEAD = {"=": "==", "is": "==", "eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">"}
_INSTEAD |= {"ge": ">=", "|": "||", "matches": "contains"}


def token_at(text: str, at: int) -> Part:
    """The piece at this place, or behind the blanks there. Raises FilterError."""
    match = _TOKEN.match(text, at)
    assert match is not None
    for kind in ("moment", "sign", "number", "quoted", "word"):
        if match[kind] is not None:
            unit = (Part("unit", *match.span("unit"), match["unit"]),) if match["unit"] else ()
            return Part(kind, match.start(kind), match.end(), match[kind], unit)
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


def octets_of(text: str) -> bytes | None:
    """The bytes that a text has in hex (`11 ff`, `0x11ff`, `11:ff`), or None if it is not hex."""
    text = text.strip()
    if text and not _OCTETS.fullmatch(text):
        return None
    return bytes.fromhex("".join(_HEX.findall(text.lower().removeprefix("0x"))))


LONGEST = 1000  # characters of a filter
DEEPEST = 40  # brackets and nots inside each other

BYTES = ("data", "hex", "bytes")
"""The names that are compared with bytes, which are written in hex without quotes: `11 ff`."""

CLOSING = {"(": ")", "[": "]", "{": "}"}
_COMPARING = ("==", "!=", "<=", ">=", "<", ">")
_KEYWORDS = ("and", "or", "not", "in", "contains")


class Place(NamedTuple):
    """Where a text ends, and what may come next there.

    Where an operand is `wanted`, it is the first of a condition, or stands behind `left` and
    `sign`. Otherwise `left` is complete: a sign may follow (unless it is `compared`), or what joins
    conditions. Inside a set (`listed`) a comma or its end may; the other end of a range is one of
    its values too, never a set. `open` is the bracket to be closed.
    """

    wanted: bool
    left: Part | None = None
    sign: str = ""
    compared: bool = False
    listed: bool = False
    open: str = ""


def parse(text: str, octets: Collection[str] = BYTES) -> Part:
    """Parse a filter. Raises FilterError.

    Behind the names in `octets` (in lower case) bytes stand in hex, without quotes.
    """
    if len(text) > LONGEST:
        sentence = f"the filter has {len(text)} characters, allowed are {LONGEST}"
        raise FilterError(sentence, LONGEST, len(text))
    if not text.strip():
        raise FilterError("the filter is empty; write a condition like faulty or latency > 20ms")
    return _Parser(text, octets).whole()


def place_at_end(text: str, octets: Collection[str] = BYTES) -> Place | None:
    """What may come next behind a text; None if it cannot be the beginning of a filter.

    `octets` are as for `parse`.
    """
    parser = _Parser(text[: LONGEST + 1], octets)
    with suppress(FilterError):
        parser.whole()
    return parser.place


class _Parser:
    """Reads one text from left to right; `place` is where it ended, once the end was reached."""

    def __init__(self, text: str, octets: Collection[str]) -> None:
        self._text = text
        self._octet_names = octets
        self._at = 0
        self._depth = 0
        self._open: list[Part] = []
        self.place: Place | None = None

    def whole(self) -> Part:
        """The whole text as one filter. Raises FilterError."""
        part = self._any()
        if self._peek().kind:
            self._refuse_rest(self._peek(), part)
        return part

    def _peek(self) -> Part:
        return token_at(self._text, self._at)

    def _take(self) -> Part:
        token = self._peek()
        self._at = token.end
        return token

    def _taken(self, *words: str) -> Part | None:
        """The next token, taken if it is one of these signs or words (in any case)."""
        token = self._peek()
        if token.kind in ("sign", "word") and token.text.lower() in words:
            return self._take()
        return None

    def _reach(self, wanted: bool, left: Part | None = None, sign: str = "", **more: bool) -> None:
        """Note the place if the text ends here; the innermost part is the first to say it."""
        if self.place is None and not self._peek().kind:
            bracket = self._open[-1].text if self._open else ""
            self.place = Place(wanted, left, sign, open=bracket, **more)

    # Conditions

    def _any(self) -> Part:
        return self._joined("or", "||", partial(self._joined, "and", "&&", self._condition))

    def _joined(self, word: str, sign: str, part: Callable[[], Part]) -> Part:
        parts = [part()]
        while self._taken(word, sign):
            parts.append(part())
        return _around(word, parts) if len(parts) > 1 else parts[0]

    def _condition(self) -> Part:
        negation = self._taken("not", "!")
        if negation is None:
            return self._comparison()
        self._deeper(negation)
        part = self._condition()
        self._depth -= 1
        return Part("not", negation.start, part.end, parts=(part,))

    def _deeper(self, token: Part) -> None:
        self._depth += 1
        if self._depth > DEEPEST:
            refuse(token, "the filter is nested too deeply")

    def _comparison(self) -> Part:
        self._reach(True)
        parts = [self._operand("")]
        while True:
            left = parts[-1]
            self._reach(False, left, compared=len(parts) > 1)
            sign = self._sign()
            if sign is None:
                return _around("compared", parts) if len(parts) > 1 else left
            self._reach(True, left, sign.text)
            parts += [sign, self._operand(sign.text, left)]

    def _sign(self) -> Part | None:
        before = self._at
        negation = self._taken("not", "!")
        token = self._taken(*([] if negation else _COMPARING), "in", "contains")
        if token is None:
            self._at = before
            return None
        words = token.text.lower()
        start = (negation or token).start
        return Part("sign", start, token.end, f"not {words}" if negation else words)

    # Operands

    def _operand(self, sign: str, left: Part | None = None) -> Part:
        """An operand, behind `left` and `sign` if there are any."""
        token = self._peek()
        among = sign.endswith("in")
        if token.text in ("{", "[") or (among and token.text == "("):
            return self._elements(self._take(), sign, left, [])
        if self._are_bytes(left, token) and not among:
            return self._octets(token)
        part = self._primary(sign, left)
        if self._taken("&"):
            self._reach(True, part, "&")
            part = _around("bits", [part, self._primary("&", part)])
        return self._ranged(part, sign, left) if among else part

    def _ranged(self, low: Part, sign: str, left: Part | None) -> Part:
        """The range that begins with `low`, if `..` follows, or else `low` itself."""
        if self._taken("..") is None:
            return low
        self._reach(True, left, sign, listed=True)
        return _around("range", [low, self._primary(sign, left)])

    def _elements(self, opening: Part, sign: str, left: Part | None, parts: list[Part]) -> Part:
        """The set of some parts and those that follow, up to the end of its bracket."""
        if not parts:
            self._open.append(opening)
            if self._closes():
                raise FilterError("a set holds one or more values", opening.start, self._peek().end)
        while not parts or (self._taken(",") and not self._closes()):
            self._reach(True, left, sign, listed=True)
            token = self._peek()
            if self._are_bytes(left, token):
                parts.append(self._octets(token))
            else:
                parts.append(self._ranged(self._primary(sign, left), sign, left))
            self._reach(False, left, sign, listed=True)
        token = self._peek()
        if token.kind and token.text not in CLOSING.values():
            refuse(token, f"a comma is missing before {token.shown!r}")
        return Part("set", opening.start, self._close().end, parts=tuple(parts))

    def _are_bytes(self, left: Part | None, token: Part) -> bool:
        """Whether a token behind `left` and a sign is the first of bytes without quotes."""
        if left is None or left.kind != "word" or left.text.lower() not in self._octet_names:
            return False
        return token.kind in ("number", "word", "moment") and token.text.lower() not in _KEYWORDS

    def _closes(self) -> bool:
        return self._peek().text == CLOSING[self._open[-1].text]

    def _close(self) -> Part:
        """Take what closes the bracket that was opened last. Raises FilterError."""
        opening, token = self._open[-1], self._peek()
        if self._closes():
            self._open.pop()
            return self._take()
        if token.text in CLOSING.values():
            refuse(token, f"{token.text!r} does not close the {opening.text!r} before it")
        if token.kind:
            self._refuse_rest(token, None)
        refuse(opening, f"this {opening.text!r} is never closed")

    def _primary(self, sign: str, left: Part | None) -> Part:
        token = self._take()
        if token.kind == "word" and token.text.lower() not in _KEYWORDS:
            return self._named(token)
        if token.kind in ("number", "moment"):
            return token
        if token.kind == "quoted":
            return token._replace(text=token.text[1:-1])
        if token.text == "(":
            return self._bracketed(token, sign, left)
        if token.kind:
            refuse(token, f"{token.shown!r} cannot stand here, expected {_wanted(sign)}")
        end = len(self._text.rstrip())
        raise FilterError(f"something is missing at the end: {_wanted(sign)}", end, end + 1)

    def _bracketed(self, opening: Part, sign: str, left: Part | None) -> Part:
        """What stands in parentheses: a condition, an operand, or a set of several values."""
        self._deeper(opening)
        self._open.append(opening)
        part = self._any()
        if self._peek().text in (",", ".."):
            part = self._elements(opening, sign, left, [self._ranged(part, sign, left)])
        else:
            self._close()
        self._depth -= 1
        return part

    def _named(self, word: Part) -> Part:
        """A name, or one byte of it."""
        if not (word.text.lower() in BYTES and self._taken("[")):
            return word
        index = self._take()
        if index.kind != "number" or self._peek().text != "]":
            name = word.text
            refuse(index, f"{name}[...] takes one number: {name}[0] is its first byte")
        return Part("item", word.start, self._take().end, parts=(word, index))

    def _octets(self, token: Part) -> Part:
        """The bytes that begin with a token, in hex without quotes."""
        match = _OCTETS.match(self._text, token.start)
        if match is None:
            piece = printable(self._text[token.start : token.end].split()[0])
            why = "is not hex with two digits for each byte; bytes are written like 05 or 11 ff"
            refuse(token, f"{piece!r} {why}")
        self._at = match.end()
        return Part("bytes", match.start(), match.end(), match[0])

    def _refuse_rest(self, token: Part, part: Part | None) -> NoReturn:
        """Say what is wrong with a token behind a part that is complete. Raises FilterError."""
        piece = token.shown
        if token.text in CLOSING.values():
            why = f"{piece!r} closes nothing that is open"
        elif instead_of(piece):
            why = f"{piece!r} {instead_of(piece)}"
        elif token.text == "&":
            why = "'&' is for one name and its bits, like rgb & 4: did you mean and?"
        elif token.text == "..":
            why = "a range follows in, like t in 1s..2s"
        elif part and part.kind in ("compared", "and", "or", "not"):
            why = f"'and' or 'or' is missing before {piece!r}"
        else:
            why = f"a sign like == or in, or else and, or, is missing before {piece!r}"
        refuse(token, why)


def _around(kind: str, parts: list[Part]) -> Part:
    """The part that consists of these."""
    return Part(kind, parts[0].start, parts[-1].end, parts=tuple(parts))


def _wanted(sign: str) -> str:
    """What must stand behind a sign, in words."""
    if not sign:
        return "a condition like faulty or latency > 20ms"
    return "a set like {1, 2} or a range like 1..2" if sign.endswith("in") else "a value or a name"
