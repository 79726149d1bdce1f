"""Compiles filter expressions (`--filter EXPR`) for JSON lines and for columns.

Python's own parser reads the expression. Each node is looked up in the tables here, and what is not
listed is refused, so no part of an expression is ever run as Python.
"""

from __future__ import annotations

import ast
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, NoReturn, get_args

from bilprov.analyzer.output.filter_tree import (
    Comparison,
    Constant,
    Joined,
    Name,
    Node,
    Not,
    Values,
    getter,
)
from bilprov.analyzer.output.json_lines import JsonLine
from bilprov.captures.schemas import Direction, FrameKind
from bilprov.captures.text import printable
from bilprov.spec.errors import UserError
from bilprov.spec.motion import VARIABLES, Motion
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.columns.stretch import Stretch
    from bilprov.analyzer.output.filter_masks import Mask

LONGEST = 1000  # characters
_ALLOWED = "and, or, not, in, ==, !=, <, <=, >, >=, parentheses, names, 'text' and numbers"

_SIGNS: dict[type[ast.cmpop], str] = {
    ast.Eq: "==",
    ast.NotEq: "!=",
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.In: "in",
    ast.NotIn: "not in",
}

HELP = """\
Show only the lines for which EXPR holds, like "faulty or latency > 0.05" or "direction == host
and state.speed > 100". It knows and, or, not, ==, !=, <, <=, >, >=, in, parentheses, numbers
(0x1f too) and 'text'; the keys of the JSON lines (direction, kind, name, hex, judgement, reason,
latency, t, sequence, answers, agrees, faults), state.motion, state.speed and so on, faulty, and
every field of an instruction by its name. Names of instructions, responses, kinds and motions
need no quotes. A comparison with something that a line does not have is false."""


_STATE_KINDS = {"motion": "text", "moving": "truth"}

KEYS = {
    name.key: name
    for name in (
        *(Name("text", key) for key in ("direction", "kind", "name", "hex")),
        *(Name("text", key) for key in ("judgement", "reason")),
        *(Name("number", key) for key in ("latency", "t", "sequence", "answers")),
        Name("truth", "agrees"),
        Name("list of text", "faults"),
        Name("truth", "faulty"),
        *(Name(_STATE_KINDS.get(v, "number"), f"state.{v}") for v in (*VARIABLES, "moving")),
    )
}


def names(protocol: Protocol) -> Mapping[str, Name]:
    """All names of a filter. A field with the same name as a key is reached as `fields.NAME`."""
    fields = {
        part.name: Name("number", f"fields.{part.name}")
        for spec in protocol.instructions
        for part in spec.fields
    }
    return {**fields, **KEYS, **{name.key: name for name in fields.values()}}


def words(protocol: Protocol) -> tuple[str, ...]:
    """The texts that need no quotes; a name takes precedence over a word of the same spelling."""
    return tuple(
        dict.fromkeys(
            [
                *(spec.name for spec in protocol.instructions),
                *(spec.name for spec in protocol.responses),
                *(kind for kind in (*get_args(FrameKind), "fault")),
                *get_args(Direction),
                *(motion.value for motion in Motion),
            ]
        )
    )


class FilterError(UserError, ValueError):
    """The expression is no valid filter. The message is one sentence with the column."""


class Filter:
    """A compiled filter: called with a line, it tells whether the line passes."""

    def __init__(self, tree: Node) -> None:
        self._tree = tree
        self._get = getter(tree)

    def __call__(self, line: JsonLine) -> bool:
        """Whether the line passes."""
        return self._get(line) is True

    def started(self, start_wall: int) -> Filter:
        """The filter for a recording that began at this time (ns since 1970)."""
        return self

    def masks(self, stretch: Stretch) -> tuple[Mask, Mask]:
        """Which of the new host rows pass, and which device rows. Line events are not asked."""
        from bilprov.analyzer.output.filter_masks import masks

        return masks(self._tree, stretch)


def compile_filter(text: str, protocol: Protocol) -> Filter:
    """Compile a filter, which tells whether a line or a row of columns passes.

    The names are those of `HELP` and the fields of the protocol's instructions. A comparison with a
    value that a line does not have is false. Raises FilterError.
    """
    if len(text) > LONGEST:
        raise FilterError(f"the filter has {len(text)} characters, allowed are {LONGEST}")
    source = text.replace("\n", " ").strip()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python's advice is about programs, not filters
            tree = ast.parse(source, mode="eval")
        return Filter(_Compiler(source, protocol).truth(tree.body))
    except SyntaxError as error:
        raise FilterError(
            f"the filter {printable(source)!r} does not parse at column {error.offset or 1}; "
            f"allowed are {_ALLOWED}"
        ) from error
    except (RecursionError, MemoryError) as error:
        raise FilterError("the filter is nested too deeply") from error
    except ValueError as error:
        if isinstance(error, FilterError):
            raise
        raise FilterError(f"the filter cannot be read: {printable(error)}") from error


class _Compiler:
    """Turns Python's nodes of one expression into ours, and refuses what is no filter."""

    def __init__(self, source: str, protocol: Protocol) -> None:
        self._source = source
        self._names = names(protocol)
        self._words = words(protocol)

    def truth(self, node: ast.expr) -> Node:
        """A condition: an expression that is true or false."""
        if isinstance(node, ast.BoolOp):
            parts = tuple(self.truth(value) for value in node.values)
            return Joined(isinstance(node.op, ast.And), parts)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return Not(self.truth(node.operand))
        if isinstance(node, ast.Compare):
            return self._comparison(node)
        value = self._value(node)
        kind = value.kind
        if kind != "truth":
            self._refuse(node, f"is a {kind}, not a condition: compare it, like {_example(kind)}")
        return value

    def _comparison(self, node: ast.Compare) -> Comparison:
        steps = []
        first = left = self._value(node.left)
        for op, right_node in zip(node.ops, node.comparators, strict=True):
            sign = _SIGNS.get(type(op))
            if sign is None:
                self._refuse(
                    right_node, f"is compared in a way that is not known; allowed are {_ALLOWED}"
                )
            right = self._value(right_node)
            self._check(right_node, left.kind, sign, right.kind)
            steps.append((sign, right))
            left = right
        return Comparison(first, tuple(steps))

    def _check(self, node: ast.expr, left: str, sign: str, right: str) -> None:
        """Refuse a comparison that can never hold, since it is a mistake. Raises FilterError."""
        if sign.endswith("in"):
            fits = right == f"list of {left}" or left == right == "text"
        else:
            fits = left == right and (sign in ("==", "!=") or left in ("number", "text"))
        if not fits:
            self._refuse(node, f"is a {right}; a {left} {sign} a {right} is never true")

    def _value(self, node: ast.expr) -> Node:
        if isinstance(node, ast.Constant):
            return self._constant(node, node.value)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            value = self._value(node.operand)
            if isinstance(node.operand, ast.Constant) and isinstance(value, Constant):
                number = value.value
                if value.kind == "number" and not isinstance(number, str):
                    return Constant("number", -number if isinstance(node.op, ast.USub) else number)
        if isinstance(node, ast.Tuple | ast.List | ast.Set):
            return self._list(node)
        if isinstance(node, ast.Name | ast.Attribute):
            return self._name(node)
        if isinstance(node, ast.BoolOp | ast.Compare | ast.UnaryOp):
            return self.truth(node)
        return self._refuse(node, f"is not allowed in a filter; allowed are {_ALLOWED}")

    def _constant(self, node: ast.expr, value: object) -> Constant:
        if isinstance(value, bool):
            return Constant("truth", value)
        if isinstance(value, int | float):
            return Constant("number", value)
        if isinstance(value, str):
            return Constant("text", value)
        return self._refuse(node, f"is not allowed in a filter; allowed are {_ALLOWED}")

    def _list(self, node: ast.Tuple | ast.List | ast.Set) -> Values:
        parts = tuple(self._value(element) for element in node.elts)
        kinds = {part.kind for part in parts}
        if len(kinds) != 1:
            self._refuse(node, "must hold one or more values of one kind")
        return Values(f"list of {kinds.pop()}", parts)

    def _name(self, node: ast.Name | ast.Attribute) -> Node:
        dotted = ast.unparse(node)
        name = self._names.get(dotted)
        if name:
            return name
        if dotted in self._words:
            return Constant("text", dotted)
        from difflib import get_close_matches

        near = get_close_matches(dotted, [*self._names, *self._words], n=3)
        meant = f", did you mean {' or '.join(near)}?" if near else ";"
        return self._refuse(node, f"is no name here{meant} --help says which there are")

    def _refuse(self, node: ast.expr, why: str) -> NoReturn:
        part = ast.get_source_segment(self._source, node) or ""
        before = self._source.encode()[: node.col_offset].decode(errors="replace")
        raise FilterError(f"filter column {len(before) + 1}: {printable(part)!r} {why}")


def _example(kind: str) -> str:
    """An example of a condition with a value of this kind."""
    examples = {"number": "latency > 0.01", "text": "direction == 'host'"}
    return examples.get(kind, "kind in ('garbage', 'gap')")
