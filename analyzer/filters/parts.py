"""The parts of a filter's text: what the parser finds, each with its columns; and FilterError."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

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


@dataclass(frozen=True, slots=True)
class Word:
    """A bare word: the name of a field, or of a value. `start` and `end` are places in the text."""

    start: int
    end: int
    text: str


@dataclass(frozen=True, slots=True)
class Quoted:
    """Text in quotes."""

    start: int
    end: int
    text: str


@dataclass(frozen=True, slots=True)
class Number:
    """A number as it is written, and its unit, empty if it has none."""

    start: int
    end: int
    text: str
    unit: str


@dataclass(frozen=True, slots=True)
class Moment:
    """A time of day or a date, as it is written."""

    start: int
    end: int
    text: str


@dataclass(frozen=True, slots=True)
class Octets:
    """Bytes that were written in hex."""

    start: int
    end: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Item:
    """One byte of a field: `data[0]`."""

    start: int
    end: int
    of: Word
    index: Number


@dataclass(frozen=True, slots=True)
class Bits:
    """The bits that both have: `rgb & 4`."""

    start: int
    end: int
    left: Part
    right: Part


@dataclass(frozen=True, slots=True)
class Range:
    """All from `low` to `high`, both included."""

    start: int
    end: int
    low: Part
    high: Part


@dataclass(frozen=True, slots=True)
class Listed:
    """A set of values and ranges."""

    start: int
    end: int
    parts: tuple[Part, ...]


@dataclass(frozen=True, slots=True)
class Sign:
    """What compares two operands: one of COMPARING, `in`, `contains`, `not in`, `not contains`."""

    start: int
    end: int
    text: str


@dataclass(frozen=True, slots=True)
class Compared:
    """A chain of comparisons: `first`, then each sign with what stands behind it."""

    start: int
    end: int
    first: Part
    steps: tuple[tuple[Sign, Part], ...]


@dataclass(frozen=True, slots=True)
class Joined:
    """Conditions with `and` between them, or (`every` is false) with `or`."""

    start: int
    end: int
    every: bool
    parts: tuple[Part, ...]


@dataclass(frozen=True, slots=True)
class Negated:
    """A condition behind `not`."""

    start: int
    end: int
    part: Part


Part: TypeAlias = (
    Word
    | Quoted
    | Number
    | Moment
    | Octets
    | Item
    | Bits
    | Range
    | Listed
    | Compared
    | Joined
    | Negated
)
