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
class _Placed:
    """Stands in the text from `start` up to, not including, `end`."""

    start: int
    end: int


@dataclass(frozen=True, slots=True)
class Word(_Placed):
    """A bare word: the name of a field, or of a value."""

    text: str


@dataclass(frozen=True, slots=True)
class Quoted(_Placed):
    """Text in quotes."""

    text: str


@dataclass(frozen=True, slots=True)
class Number(_Placed):
    """A number as it is written, and its unit, empty if it has none."""

    text: str
    unit: str


@dataclass(frozen=True, slots=True)
class Moment(_Placed):
    """A time of day or a date, as it is written."""

    text: str


@dataclass(frozen=True, slots=True)
class Octets(_Placed):
    """Bytes that were written in hex."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Item(_Placed):
    """One byte of a field: `data[0]`."""

    of: Word
    index: Number


@dataclass(frozen=True, slots=True)
class Bits(_Placed):
    """The bits that both have: `rgb & 4`."""

    left: Part
    right: Part


@dataclass(frozen=True, slots=True)
class Range(_Placed):
    """All from `low` to `high`, both included."""

    low: Part
    high: Part


@dataclass(frozen=True, slots=True)
class Listed(_Placed):
    """A set of values and ranges."""

    parts: tuple[Part, ...]


@dataclass(frozen=True, slots=True)
class Sign(_Placed):
    """What compares two operands: one of COMPARING, `in`, `contains`, `not in`, `not contains`."""

    text: str


@dataclass(frozen=True, slots=True)
class Compared(_Placed):
    """A chain of comparisons: `first`, then each sign with what stands behind it."""

    first: Part
    steps: tuple[tuple[Sign, Part], ...]


@dataclass(frozen=True, slots=True)
class Joined(_Placed):
    """Conditions with `and` between them, or (`every` is false) with `or`."""

    every: bool
    parts: tuple[Part, ...]


@dataclass(frozen=True, slots=True)
class Negated(_Placed):
    """A condition behind `not`."""

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
