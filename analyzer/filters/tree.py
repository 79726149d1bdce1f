"""The syntax tree of a checked filter, and its meaning for one row: a JSON line.

A row that lacks a value has None for it, and no comparison with it holds. What the tree means for
columns stands in masks.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

from bilprov.analyzer.decode.json_lines import JsonLine
from bilprov.analyzer.filters.moments import of_day
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol

Get: TypeAlias = Callable[[JsonLine], Any]
Test: TypeAlias = Callable[[JsonLine], bool]

COMPARISONS: Mapping[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}

TIME_OF_DAY, DATE = "time of day", "date"
"""The keys of a row's wall clock in ns: since local midnight, and since 1970."""


@dataclass(frozen=True, slots=True)
class Constant:
    """A value that is the same in all rows: a number, a word, true or false, bytes, or kinds."""

    value: float | str | bytes | frozenset[str]


@dataclass(frozen=True, slots=True)
class Name:
    """A value of the row: the `key` of a Field, TIME_OF_DAY or DATE."""

    key: str


@dataclass(frozen=True, slots=True)
class Item:
    """The byte of that number, from 0, in a value of bytes."""

    key: str
    index: int


@dataclass(frozen=True, slots=True)
class Bits:
    """The bits that two whole numbers both have."""

    left: Operand
    right: Operand


Operand: TypeAlias = Constant | Name | Item | Bits


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two operands of one kind, and a sign of COMPARISONS between them."""

    left: Operand
    sign: str
    right: Operand


@dataclass(frozen=True, slots=True)
class Among:
    """Whether a value is one of those from a first to a last one, or (`holds` is false) is not."""

    left: Operand
    ranges: tuple[tuple[Operand, Operand], ...]
    holds: bool


@dataclass(frozen=True, slots=True)
class Contains:
    """Whether text, bytes or kinds contain a part, or (`holds` is false) do not."""

    key: str
    part: str | bytes
    holds: bool


@dataclass(frozen=True, slots=True)
class Joined:
    """Conditions of which all must hold, or (`every` is false) at least one."""

    every: bool
    parts: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class Not:
    """Holds where the condition does not."""

    part: Node


Node: TypeAlias = Comparison | Among | Contains | Joined | Not


@dataclass(frozen=True, slots=True)
class Lines:
    """Asks JSON lines of a recording.

    `start` is the wall clock (ns since 1970) at the recording's start, None where it is unknown:
    then no row has a time of day.
    """

    protocol: Protocol
    start: int | None = None

    def test(self, node: Node) -> Test:
        """A function that tells whether a condition holds for a line."""
        match node:
            case Comparison(left=left, sign=sign, right=right):
                return _compared(self.get(left), COMPARISONS[sign], self.get(right))
            case Among():
                return self._among(node)
            case Contains(key=key, part=part, holds=holds):
                return _contains(self._named(key), part, holds)
            case Not(part=negated):
                holds_not = self.test(negated)
                return lambda line: not holds_not(line)
            case Joined(every=every, parts=parts):
                tests = [self.test(one) for one in parts]
                if every:
                    return lambda line: all(test(line) for test in tests)
                return lambda line: any(test(line) for test in tests)

    def get(self, operand: Operand) -> Get:
        """A function that gets an operand's value from a line, None where the line lacks it."""
        match operand:
            case Constant(value=value):
                return lambda line: value
            case Name(key=key):
                return self._named(key)
            case Item(key=key, index=index):
                return _item(self._named(key), index)
            case Bits(left=left, right=right):
                return _bits(self.get(left), self.get(right))

    def _among(self, node: Among) -> Test:
        get, holds = self.get(node.left), node.holds
        ends = [(self.get(low), self.get(high)) for low, high in node.ranges]

        def among(line: JsonLine) -> bool:
            value = get(line)
            if value is None:
                return False
            pairs = ((low(line), high(line)) for low, high in ends)
            found = any(
                low is not None and high is not None and low <= value <= high for low, high in pairs
            )
            return found is holds

        return among

    def _named(self, key: str) -> Get:
        space, _, name = key.rpartition(".")
        if space == "fields":
            return lambda line: line.fields.get(name)
        if space == "state":
            return lambda line: getattr(line.state, name)
        made = self._made.get(key)
        return made(self) if made else operator.attrgetter(key)

    def _header(self, place: int) -> Get:
        """The ID or the length in the header of a row with an instruction."""
        headers = self.protocol.headers
        return lambda line: headers[int(line.hex[:2], 16)][place] if _is_instruction(line) else None

    def _id(self) -> Get:
        return self._header(0)

    def _len(self) -> Get:
        return self._header(1)

    def _hex(self) -> Get:
        return lambda line: bytes.fromhex(line.hex)

    def _data(self) -> Get:
        return lambda line: bytes.fromhex(line.hex)[1:] if _is_instruction(line) else None

    def _response(self) -> Get:
        return lambda line: int(line.hex, 16) if line.kind == "response" else None

    def _judgement(self) -> Get:
        codes = {spec.name: spec.code for spec in self.protocol.responses}
        return lambda line: codes.get(line.judgement) if line.judgement else None

    def _faults(self) -> Get:
        return lambda line: frozenset(line.faults)

    def _faulty(self) -> Get:
        fine = (None, self.protocol.answers[Outcome.VALID].name)
        return lambda line: bool(line.faults) or line.judgement not in fine

    def _date(self) -> Get:
        start = self.start
        if start is None:
            return lambda line: None
        return lambda line: start + round(line.t * 1e9)

    def _time_of_day(self) -> Get:
        get_date = self._date()
        if self.start is None:
            return get_date
        return lambda line: of_day(get_date(line))

    # What is not simply a key of the line.
    _made: ClassVar[Mapping[str, Callable[[Lines], Get]]] = {
        "id": _id,
        "len": _len,
        "data": _data,
        "hex": _hex,
        "response": _response,
        "judgement": _judgement,
        "faults": _faults,
        "faulty": _faulty,
        DATE: _date,
        TIME_OF_DAY: _time_of_day,
    }


def _is_instruction(line: JsonLine) -> bool:
    return line.kind in ("instruction", "truncated")


def _compared(get_left: Get, compare: Callable[[Any, Any], bool], get_right: Get) -> Test:
    def holds(line: JsonLine) -> bool:
        left, right = get_left(line), get_right(line)
        return left is not None and right is not None and compare(left, right)

    return holds


def _contains(get: Get, part: str | bytes, wanted: bool) -> Test:
    def contains(line: JsonLine) -> bool:
        whole = get(line)
        return whole is not None and (part in whole) is wanted

    return contains


def _item(get: Get, index: int) -> Get:
    def item(line: JsonLine) -> int | None:
        data = get(line)
        return None if data is None or len(data) <= index else data[index]

    return item


def _bits(get_left: Get, get_right: Get) -> Get:
    def bits(line: JsonLine) -> int | None:
        left, right = get_left(line), get_right(line)
        return None if left is None or right is None else left & right

    return bits
