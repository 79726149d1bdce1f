"""The syntax tree of a filter expression, and its meaning for one JSON line.

Each node has the kind of its value: `number`, `text`, `truth`, or a list of one of these. What it
means for columns stands in filter_masks.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

from bilprov.analyzer.output.json_lines import JsonLine

Getter: TypeAlias = Callable[[JsonLine], Any]


class _Missing:
    """The type of MISSING, a value that a line does not have: no comparison with it holds."""


MISSING = _Missing()

COMPARISONS: dict[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "in": lambda one, many: one in many,
    "not in": lambda one, many: one not in many,
}


@dataclass(frozen=True, slots=True)
class Constant:
    """A number, a text, or a truth value."""

    kind: str
    value: float | str | bool


@dataclass(frozen=True, slots=True)
class Name:
    """A value of the line: `key` is one of its keys, `state.VARIABLE`, `fields.FIELD`, `faulty`."""

    kind: str
    key: str


@dataclass(frozen=True, slots=True)
class Values:
    """A list of one or more values of one kind."""

    kind: str
    parts: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class Comparison:
    """A chain of comparisons: `first`, then each sign of COMPARISONS with what it is held against.

    It holds if each of them holds; one with MISSING does not.
    """

    kind: ClassVar[str] = "truth"
    first: Node
    steps: tuple[tuple[str, Node], ...]


@dataclass(frozen=True, slots=True)
class Joined:
    """Conditions of which all must be true, or (`every` is false) at least one."""

    kind: ClassVar[str] = "truth"
    every: bool
    parts: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class Not:
    """True where the condition is not."""

    kind: ClassVar[str] = "truth"
    part: Node


Node: TypeAlias = Constant | Name | Values | Comparison | Joined | Not


def getter(node: Node) -> Getter:
    """A function that gets the node's value from a line."""
    match node:
        case Constant(value=value):
            return lambda line: value
        case Name(key=key):
            return _named(key)
        case Values(parts=parts):
            gets = [getter(part) for part in parts]
            return lambda line: tuple(get(line) for get in gets)
        case Comparison():
            return _comparison(node)
        case Not(part=part):
            get_part = getter(part)
            return lambda line: get_part(line) is not True
        case Joined(every=every, parts=parts):
            conditions = [getter(part) for part in parts]
            if every:
                return lambda line: all(condition(line) is True for condition in conditions)
            return lambda line: any(condition(line) is True for condition in conditions)


def _named(key: str) -> Getter:
    space, _, name = key.rpartition(".")
    if space == "fields":
        return lambda line: line.fields.get(name, MISSING)
    if space == "state":
        return lambda line: getattr(line.state, name)
    if key == "faulty":
        return lambda line: bool(line.faults)

    def get(line: JsonLine) -> Any:
        value = getattr(line, key)
        return MISSING if value is None else value

    return get


def _comparison(node: Comparison) -> Getter:
    steps = []
    left = getter(node.first)
    for sign, other in node.steps:
        right = getter(other)
        steps.append((left, COMPARISONS[sign], right))
        left = right

    def holds(line: JsonLine) -> bool:
        for get_left, compare, get_right in steps:
            one, other = get_left(line), get_right(line)
            if one is MISSING or other is MISSING or not compare(one, other):
                return False
        return True

    return holds
