"""What a filter means for columns: a mask over the rows of a Stretch. Needs numpy.

A mask holds for the same rows as the filter for their JSON lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from bilprov.analyzer.columns.stretch import Stretch
from numpy.typing import NDArray

from bilprov.analyzer.filters.columns import (
    Column,
    DeviceRows,
    HostRows,
    Mask,
    Numbers,
    Octets,
    Rows,
    Words,
)
from bilprov.analyzer.filters.tree import (
    COMPARISONS,
    Among,
    Bits,
    Comparison,
    Constant,
    Contains,
    Item,
    Joined,
    Name,
    Node,
    Not,
    Operand,
)

_UFUNCS: dict[str, Callable[[Any, Any], Any]] = {
    "==": np.equal,
    "!=": np.not_equal,
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
}


def masks(tree: Node, stretch: Stretch, start: int | None = None) -> tuple[Mask, Mask]:
    """In which of the new host rows, and in which device rows, a condition holds.

    `start` is the wall clock (ns since 1970) at the recording's start, None if it is not known.
    """
    host, device = HostRows(stretch, start), DeviceRows(stretch, start)
    return _mask(host, tree), _mask(device, tree)


def _mask(rows: Rows, node: Node) -> Mask:
    """In which rows a condition holds."""
    if not rows.count:
        return np.zeros(0, np.bool_)
    return np.broadcast_to(_true(rows, node), rows.count)


def _true(rows: Rows, node: Node) -> Mask:
    match node:
        case Comparison(left=left, sign=sign, right=right):
            return _compared(_operand(rows, left), sign, _operand(rows, right))
        case Among():
            return _among(rows, node)
        case Contains(key=key, part=part, holds=holds):
            return _containing(rows.column(key), part, holds)
        case Not(part=part):
            return ~_true(rows, part)
        case Joined(every=every, parts=parts):
            return _joined(rows, parts, every)


def _joined(rows: Rows, parts: Sequence[Node], every: bool) -> Mask:
    true = _true(rows, parts[0])
    for part in parts[1:]:
        if (every and not true.any()) or (not every and true.all()):
            break  # the other parts change nothing
        true = true & _true(rows, part) if every else true | _true(rows, part)
    return true


def _among(rows: Rows, node: Among) -> Mask:
    column = _operand(rows, node.left)
    true: Mask = np.zeros((), np.bool_)
    for low, high in node.ranges:
        if low == high:
            true = true | _compared(column, "==", _operand(rows, low))
            continue
        above = _compared(column, ">=", _operand(rows, low))
        true = true | (above & _compared(column, "<=", _operand(rows, high)))
    return true if node.holds else _present(column) & ~true


def _operand(rows: Rows, operand: Operand) -> Column:
    match operand:
        case Constant(value=value):
            return _constant(value)
        case Name(key=key):
            return rows.column(key)
        case Item(key=key, index=index):
            return _item(rows.column(key), index)
        case Bits(left=left, right=right):
            return _bits(_operand(rows, left), _operand(rows, right))


def _constant(value: float | str | bytes | frozenset[str]) -> Column:
    """A value that is the same in all rows."""
    if isinstance(value, bytes):
        data = np.frombuffer(value, np.uint8)
        return Octets(data, np.zeros((), np.int64), np.array(len(data)))
    if isinstance(value, bool | str | frozenset):
        return Words(np.zeros((), np.int64), (value,))
    return Numbers(value)


def _item(column: Column, index: int) -> Numbers:
    """One byte of each row."""
    if isinstance(column, Numbers):
        return column
    assert isinstance(column, Octets)
    value = column.data.take(column.start + index, mode="clip")
    return Numbers(value, column.size > index)


def _bits(left: Column, right: Column) -> Numbers:
    assert isinstance(left, Numbers)
    assert isinstance(right, Numbers)
    present = _both(left.present, right.present)
    values = (np.asarray(one.value).astype(np.int64) for one in (left, right))
    return Numbers(np.bitwise_and(*values), present)


def _both(left: Mask | None, right: Mask | None) -> Mask | None:
    if left is None or right is None:
        return right if left is None else left
    return left & right


def _present(column: Column) -> Mask:
    """In which rows a column has a value."""
    match column:
        case Numbers(present=present):
            return np.ones((), np.bool_) if present is None else present
        case Words(code=code, words=words):
            return np.array([word is not None for word in words]).take(code)
    return np.asarray(column.size >= 0)


def _compared(left: Column, sign: str, right: Column) -> Mask:
    """In which rows two columns have values that compare so."""
    if isinstance(left, Numbers) and isinstance(right, Numbers):
        true = np.asarray(_UFUNCS[sign](left.value, right.value), np.bool_)
        present = _both(left.present, right.present)
        return true if present is None else true & present
    if isinstance(left, Octets) and isinstance(right, Octets):
        same = _equal(left, right.data)
        return same if sign == "==" else (left.size >= 0) & ~same
    assert isinstance(left, Words)
    assert isinstance(right, Words)
    compare = COMPARISONS[sign]
    many = len(right.words)
    holds = [
        one is not None and other is not None and compare(one, other)
        for one in left.words
        for other in right.words
    ]
    table = np.array(holds, np.bool_)
    if right.code.ndim == 0:
        return table[int(right.code) :: many].take(left.code)
    return table.take(left.code.astype(np.int64) * many + right.code)


def _equal(column: Octets, part: NDArray[np.uint8]) -> Mask:
    """In which rows the bytes are these."""
    rows = np.flatnonzero(column.size == len(part))
    for place, byte in enumerate(part.tolist()):
        rows = rows[column.data.take(column.start[rows] + place) == byte]
    true = np.zeros(len(column.size), np.bool_)
    true[rows] = True
    return true


def _containing(column: Column, part: str | bytes, wanted: bool) -> Mask:
    """In which rows a column contains a part, or (`wanted` is false) has a value without it."""
    if isinstance(column, Words):
        holds = [word is not None and (part in word) is wanted for word in column.words]
        return np.array(holds, np.bool_).take(column.code)
    assert isinstance(column, Octets)
    assert isinstance(part, bytes)
    last = len(column.data) - len(part)
    if last < 0:
        return np.asarray((column.size >= 0) & (not wanted))
    hits = np.ones(last + 1, np.bool_)
    for place, byte in enumerate(part):
        hits &= column.data[place : last + 1 + place] == byte
    before = np.append(0, np.cumsum(hits))  # how many begin before each place
    first = np.minimum(column.start, last + 1)
    behind = np.clip(column.start + column.size - len(part) + 1, first, last + 1)
    true = before.take(behind) > before.take(first)
    return np.asarray((column.size >= 0) & (true if wanted else ~true))
