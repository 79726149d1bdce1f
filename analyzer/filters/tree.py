"""The syntax tree of a checked filter. Plain values: what it means for rows stands in `masks`.

A row that lacks a value passes no comparison with it.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

TIME_OF_DAY, DATE = "time of day", "time"
"""The keys of a row's wall clock in ns: since local midnight, and since 1970."""


class Constant(NamedTuple):
    """A value that is the same in all rows: a number, a word, true or false, bytes, or kinds."""

    value: float | str | bytes | frozenset[str]


class Name(NamedTuple):
    """A value of the row: the `key` of a Field, TIME_OF_DAY or DATE.

    With a `place` it is the byte of that number, from 0, in a value of bytes.
    """

    key: str
    place: int | None = None


class Bits(NamedTuple):
    """The bits that a whole number of the row has of a mask."""

    left: Name
    mask: int


Operand: TypeAlias = Constant | Name | Bits


class Comparison(NamedTuple):
    """Two operands of one kind with a sign between them.

    One of `== != < <= > >=`, and behind text, bytes or kinds `contains` and `not contains`.
    """

    left: Operand
    sign: str
    right: Operand


class Joined(NamedTuple):
    """Conditions of which all must hold, or (`every` is false) at least one."""

    every: bool
    parts: tuple[Node, ...]


class Not(NamedTuple):
    """Holds where the condition does not."""

    part: Node


Node: TypeAlias = Comparison | Joined | Not
