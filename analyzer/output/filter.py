"""Compiles filter expressions (`--filter EXPR`) over JSON lines into functions.

Python's own parser reads the expression. Each node is looked up in the tables here, and what is not
listed is refused, so no part of an expression is ever run as Python.
"""

from __future__ import annotations

import ast
import operator
import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, NoReturn, get_args

from bilprov.analyzer.output.json_lines import JsonLine
from bilprov.captures.schemas import Direction, FrameKind
from bilprov.captures.text import printable
from bilprov.spec.errors import UserError
from bilprov.spec.motion import VARIABLES, Motion
from bilprov.spec.protocol import Protocol

LONGEST = 1000  # characters
_ALLOWED = "and, or, not, in, ==, !=, <, <=, >, >=, parentheses, names, 'text' and numbers"

_COMPARISONS: dict[type[ast.cmpop], tuple[str, Callable[[Any, Any], bool]]] = {
    ast.Eq: ("==", operator.eq),
    ast.NotEq: ("!=", operator.ne),
    ast.Lt: ("<", operator.lt),
    ast.LtE: ("<=", operator.le),
    ast.Gt: (">", operator.gt),
    ast.GtE: (">=", operator.ge),
    ast.In: ("in", lambda one, many: one in many),
    ast.NotIn: ("not in", lambda one, many: one not in many),
}

# A part of an expression: the kind of its value, and a function that gets the value from a line.
_Part = tuple[str, Callable[[JsonLine], Any]]


class _Missing:
    """The type of MISSING, a value that a line does not have: no comparison with it holds."""


MISSING = _Missing()

HELP = """\
Show only the lines for which EXPR holds, like "faulty or latency > 0.05" or "direction == host
and state.speed > 100". It knows and, or, not, ==, !=, <, <=, >, >=, in, parentheses, numbers
(0x1f too) and 'text'; the keys of the JSON lines (direction, kind, name, hex, judgement, reason,
latency, t, sequence, answers, agrees, faults), state.motion, state.speed and so on, faulty, and
every field of an instruction by its name. Names of instructions, responses, kinds and motions
need no quotes. A comparison with something that a line does not have is false."""


class Name(NamedTuple):
    """A name's kind of value (`text`, `number`, `truth`, `list of text`), and its getter."""

    kind: str
    get: Callable[[JsonLine], Any]


def _of(kind: str, key: str) -> Name:
    def get(line: JsonLine) -> Any:
        value = getattr(line, key)
        return MISSING if value is None else value

    return Name(kind, get)


def _field(name: str) -> Name:
    return Name("number", lambda line: line.fields.get(name, MISSING))


def _state(variable: str) -> Name:
    kind = {"motion": "text", "moving": "truth"}.get(variable, "number")
    return Name(kind, lambda line: getattr(line.state, variable))


KEYS = {
    **{key: _of("text", key) for key in ("direction", "kind", "name", "hex")},
    **{key: _of("text", key) for key in ("judgement", "reason")},
    **{key: _of("number", key) for key in ("latency", "t", "sequence", "answers")},
    "agrees": _of("truth", "agrees"),
    "faults": _of("list of text", "faults"),
    "faulty": Name("truth", lambda line: bool(line.faults)),
    **{f"state.{variable}": _state(variable) for variable in (*VARIABLES, "moving")},
}


def names(protocol: Protocol) -> Mapping[str, Name]:
    """All names of a filter. A field with the same name as a key is reached as `fields.NAME`."""
    fields = {
        part.name: _field(part.name) for spec in protocol.instructions for part in spec.fields
    }
    return {**fields, **KEYS, **{f"fields.{name}": get for name, get in fields.items()}}


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


def compile_filter(text: str, protocol: Protocol) -> Callable[[JsonLine], bool]:
    """Compile a filter into a function that tells whether a line passes.

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
        found = _Compiler(source, protocol).truth(tree.body)
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
    return lambda line: bool(found(line) is True)


class _Compiler:
    """Turns the nodes of one expression into functions of a line."""

    def __init__(self, source: str, protocol: Protocol) -> None:
        self._source = source
        self._names = names(protocol)
        self._words = words(protocol)

    def truth(self, node: ast.expr) -> Callable[[JsonLine], Any]:
        """Compile a condition: an expression that is true or false."""
        if isinstance(node, ast.BoolOp):
            parts = [self.truth(value) for value in node.values]
            if isinstance(node.op, ast.And):
                return lambda line: all(part(line) is True for part in parts)
            return lambda line: any(part(line) is True for part in parts)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            part = self.truth(node.operand)
            return lambda line: part(line) is not True
        if isinstance(node, ast.Compare):
            return self._comparison(node)
        kind, get = self._value(node)
        if kind != "truth":
            self._refuse(node, f"is a {kind}, not a condition: compare it, like {_example(kind)}")
        return get

    def _comparison(self, node: ast.Compare) -> Callable[[JsonLine], bool]:
        steps = []
        left = self._value(node.left)
        for op, right_node in zip(node.ops, node.comparators, strict=True):
            if type(op) not in _COMPARISONS:
                self._refuse(
                    right_node, f"is compared in a way that is not known; allowed are {_ALLOWED}"
                )
            sign, compare = _COMPARISONS[type(op)]
            right = self._value(right_node)
            self._check(right_node, left[0], sign, right[0])
            steps.append((left[1], compare, right[1]))
            left = right

        def holds(line: JsonLine) -> bool:
            for get_left, compare, get_right in steps:
                one, other = get_left(line), get_right(line)
                if one is MISSING or other is MISSING or not compare(one, other):
                    return False
            return True

        return holds

    def _check(self, node: ast.expr, left: str, sign: str, right: str) -> None:
        """Refuse a comparison that can never hold, since it is a mistake. Raises FilterError."""
        if sign.endswith("in"):
            fits = right == f"list of {left}" or left == right == "text"
        else:
            fits = left == right and (sign in ("==", "!=") or left != "truth")
        if not fits:
            self._refuse(node, f"is a {right}; a {left} {sign} a {right} is never true")

    def _value(self, node: ast.expr) -> _Part:
        if isinstance(node, ast.Constant):
            return self._constant(node, node.value)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            kind, get = self._value(node.operand)
            if kind == "number" and isinstance(node.operand, ast.Constant):
                factor = -1 if isinstance(node.op, ast.USub) else 1
                number = factor * get(None)  # type: ignore[arg-type]  # a constant asks no line
                return kind, lambda line: number
        if isinstance(node, ast.Tuple | ast.List | ast.Set):
            return self._list(node)
        if isinstance(node, ast.Name | ast.Attribute):
            return self._name(node)
        if isinstance(node, ast.BoolOp | ast.Compare | ast.UnaryOp):
            return "truth", self.truth(node)
        return self._refuse(node, f"is not allowed in a filter; allowed are {_ALLOWED}")

    def _constant(self, node: ast.expr, value: object) -> _Part:
        if isinstance(value, bool):
            return "truth", lambda line: value
        if isinstance(value, int | float):
            return "number", lambda line: value
        if isinstance(value, str):
            return "text", lambda line: value
        return self._refuse(node, f"is not allowed in a filter; allowed are {_ALLOWED}")

    def _list(self, node: ast.Tuple | ast.List | ast.Set) -> _Part:
        parts = [self._value(element) for element in node.elts]
        kinds = {kind for kind, _ in parts}
        if len(kinds) != 1:
            self._refuse(node, "must hold one or more values of one kind")
        gets = [get for _, get in parts]
        return f"list of {kinds.pop()}", lambda line: [get(line) for get in gets]

    def _name(self, node: ast.Name | ast.Attribute) -> _Part:
        dotted = ast.unparse(node)
        name: Name | None = self._names.get(dotted)
        if name:
            return name.kind, name.get
        if dotted in self._words:
            return "text", lambda line: dotted
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
