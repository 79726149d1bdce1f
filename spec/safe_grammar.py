"""Checks that a grammar's text holds declarations only and is safe to run, whoever wrote it.

A grammar is Python. One that the user names is run unchecked. One from a file that somebody else
may have made is run only if it holds nothing but imports of the names below, constants, and calls
of those names, as the kit's own grammar does. Such a text can reach nothing else, and with every
name replaced by its value it is so short and so flat that whoever walks its values ends soon.
"""

from __future__ import annotations

import ast
import warnings

from bilprov.spec import fields
from bilprov.spec.errors import one_line

WORDS = {
    "__future__": {"annotations"},
    "construct": {
        *("BitStruct", "BitsInteger", "Nibble", "Struct", "Switch", "this"),
        *("Array", "Bytes", "Checksum", "Const", "Enum", "FixedSized", "FlagsEnum"),
        "Pass",
        *("GreedyBytes", "GreedyRange", "Prefixed", "PrefixedArray", "RawCopy"),
        *("Byte", "Int8ub", "Int8sb", "Int8ul", "Int8sl", "BytesInteger"),
        *(f"Int{bits}{kind}" for bits in (16, 24, 32, 64) for kind in ("ub", "ul", "sb", "sl")),
    },
    "bilprov.spec.fields": {*fields.__all__},
    "bilprov.spec.motion": {"Motion"},
}
"""The names that a grammar may import, by module."""

_NO_WIDTHS = ("Const", "Enum", "FlagsEnum", "Struct")  # their numbers, if any, are values
_PATHS = ("this", "asked")  # names that stand for what was parsed before

LONGEST = 1 << 18  # characters of a grammar's text
LARGEST_EXPANSION = 1 << 15  # parts of its values together, each name replaced by its value
DEEPEST = 40  # parts within each other; the kit's own grammar has 12
_LARGEST = 1 << 32  # the largest number
_SHOWN = 60  # characters of what is no declaration
_WIDEST = 64  # the largest number passed to construct, which allocates memory for widths


class NotDeclared(Exception):
    """Raised for a text with more than declarations; the message says what, and in which line."""


def require_declarations(source: str) -> None:
    """Raise NotDeclared unless the text holds declarations only (at most LONGEST characters)."""
    if len(source) > LONGEST:
        raise NotDeclared(f"it is {len(source)} characters long, allowed are {LONGEST}")
    try:
        with warnings.catch_warnings():  # Python's remarks about the text are not ours to print
            warnings.simplefilter("ignore")
            tree = ast.parse(source)
        _Vetting(source).statements(tree)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise NotDeclared(f"it cannot be parsed: {type(error).__name__}") from error


def _today(module: str) -> str:
    """Return the module's current name; older grammars import `spec.fields`."""
    return f"bilprov.{module}" if module.startswith("spec.") else module


class _Vetting:
    def __init__(self, source: str) -> None:
        self._source = source
        self._words: dict[str, str] = {}  # imported name -> module
        self._values: dict[str, ast.expr] = {}  # assigned name -> its value, which is no name
        self._extents: dict[str, tuple[int, int]] = {}  # assigned name -> parts, depth of its value
        self._size = 0  # parts so far

    def statements(self, tree: ast.Module) -> None:
        for node in tree.body:
            match node:
                case ast.Expr(ast.Constant(str())):
                    pass
                case ast.ImportFrom(str(module), names, 0) if _today(module) in WORDS:
                    for name in names:
                        if name.asname or name.name not in WORDS[_today(module)]:
                            raise _refused(node, f"it imports {name.name} from {module}")
                        self._words[name.name] = module
                case ast.Assign([ast.Name(name)], value) if self._free(name):
                    before = self._size
                    depth = self._check(value)
                    self._extents[name] = (self._size - before, depth)
                    self._values[name] = self._meant(value)
                case _:
                    raise self._other(node)

    def _other(self, node: ast.AST) -> NotDeclared:
        """The refusal of what is no declaration, with its text."""
        text = ast.get_source_segment(self._source, node) or ""
        return _refused(node, f"there is {one_line(text, _SHOWN)}")

    def _free(self, name: str) -> bool:
        """Return whether a name may be assigned: not assigned, not imported, not beginning `__`."""
        return not (name in self._words or name in self._values or name.startswith("__"))

    def _check(self, node: ast.expr) -> int:
        """Refuse what is no declaration; return how many parts lie within each other."""
        size, depth = 1, 0
        parts: list[ast.expr] = []
        match node:
            case ast.Constant(value):
                _check_constant(node, value)
            case ast.UnaryOp(ast.USub(), ast.Constant(int() | float() as value)):
                _check_constant(node, value)
            case ast.Name(name) if name in self._words:
                pass
            case ast.Name(name) if name in self._extents:
                size, depth = self._extents[name]
            case ast.Attribute():
                size = depth = self._check_attribute(node)
            case ast.Tuple(items) | ast.List(items):
                parts = items
            case ast.Starred(ast.Name() as name) if isinstance(self._meant(name), ast.Tuple):
                parts = [name]
            case ast.Dict(keys, values) if None not in keys:
                parts = [*(key for key in keys if key is not None), *values]
            case ast.Call(ast.Name(name), arguments, keywords) if self._called(name):
                given = [*arguments, *(word.value for word in keywords if word.arg)]
                if len(given) < len(arguments) + len(keywords):
                    raise _refused(node, "there is a **")
                parts = given
                if self._words[name] == "construct" and name not in _NO_WIDTHS:
                    self._check_widths(node, given)
            case ast.Call(ast.Name("bytes"), [ast.Constant(int(count))], []) if (
                self._free("bytes") and 0 <= count <= _WIDEST
            ):
                pass  # so many zeros
            case ast.BinOp(ast.Constant(str()), ast.Div(), right):
                parts = [right]
            case ast.BinOp(left, ast.Mult(), ast.Constant(str())) if self._declares(left):
                parts = [left]
            case ast.BinOp(left, ast.Add() | ast.Mult(), right) if _is_path(left):
                parts = [left, right] if _is_path(right) else [left, _number(right)]
            case _:
                raise self._other(node)
        self._size += size
        if self._size > LARGEST_EXPANSION:
            raise _refused(node, f"with names replaced it has over {LARGEST_EXPANSION} parts")
        depth = 1 + max([depth, *map(self._check, parts)])
        if depth > DEEPEST:
            raise _refused(node, f"more than {DEEPEST} parts lie within each other")
        return depth

    def _called(self, name: str) -> bool:
        """Return whether a name may be called: a call of `this` would only hide its argument."""
        return name in self._words and name not in (*_PATHS, "annotations")

    def _check_attribute(self, node: ast.Attribute) -> int:
        """Accept `Motion.STOPPED`, `Outcome.VALID`, `this.header.id`; refuse other attributes.

        Returns how many attributes there are.
        """
        inner: ast.expr = node
        count = 0
        while isinstance(inner, ast.Attribute):
            count += 1
            if inner.attr.startswith("_") and inner.attr != "_":  # that is the Struct around
                raise _refused(node, f"there is a .{inner.attr}")
            inner = inner.value
        if not isinstance(inner, ast.Name) or inner.id not in self._words:
            raise _refused(node, "there is an attribute of something else")
        simple = inner is node.value
        if inner.id not in _PATHS and not (inner.id in ("Motion", "Outcome") and simple):
            raise _refused(node, f"there is an attribute of {inner.id}")
        return count

    def _declares(self, node: ast.expr) -> bool:
        """Return whether the node is a declaration: a text times a number could fill the memory."""
        if isinstance(node, ast.Name) and node.id in self._words:
            return True
        return isinstance(self._meant(node), ast.Call | ast.BinOp)

    def _meant(self, node: ast.expr) -> ast.expr:
        """Return the value of an assigned name; any other node is returned as it is."""
        return self._values.get(node.id, node) if isinstance(node, ast.Name) else node

    def _check_widths(self, node: ast.expr, given: list[ast.expr]) -> None:
        for part in map(self._meant, given):
            if isinstance(part, ast.Starred):
                raise self._other(part)
            number = part.value if isinstance(part, ast.Constant) else 0
            if isinstance(number, int | float) and number > _WIDEST:
                raise _refused(node, f"a width of {number} is above {_WIDEST}")


def _is_path(node: ast.expr) -> bool:
    """Whether the node is a value that was parsed before: `this.size`, `asked.covered.data`."""
    while isinstance(node, ast.Attribute):
        node = node.value
    return isinstance(node, ast.Name) and node.id in _PATHS


def _number(node: ast.expr) -> ast.expr:
    """The node, which must be a number that a count is multiplied with or added to."""
    if isinstance(node, ast.Constant) and isinstance(node.value, int):
        return node
    raise _refused(node, "there is a count that is not made of whole numbers")


def _check_constant(node: ast.expr, value: object) -> None:
    if isinstance(value, int | float) and abs(value) > _LARGEST:
        raise _refused(node, "there is a number above 2 to the 32nd")
    if isinstance(value, bytes):
        if len(value) > _WIDEST:
            raise _refused(node, f"there are {len(value)} bytes, allowed are {_WIDEST},")
    elif not isinstance(value, str | int | float | None):
        raise _refused(node, f"there is a constant of type {type(value).__name__}")


def _refused(node: ast.AST, what: str) -> NotDeclared:
    return NotDeclared(f"{one_line(what, 200)} in line {getattr(node, 'lineno', 0)}")
