"""What a filter means for the rows of a batch: which of them pass. Needs numpy."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.decode.batch import Batch, Mask, Selection
from bilprov.analyzer.decode.json_lines import json_line
from bilprov.analyzer.filters import tree
from bilprov.analyzer.filters.columns import (
    NOTHING,
    Column,
    Columns,
    Numbers,
    Octets,
    Words,
    device_columns,
    host_columns,
    line_columns,
)
from bilprov.spec.protocol import Protocol

# What compares two values; all but the last two also compare two arrays value by value.
_COMPARING: Mapping[str, Callable[[Any, Any], Any]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "contains": operator.contains,
    "not contains": lambda whole, part: part not in whole,
}


def selection(
    test: tree.Node, protocol: Protocol, batch: Batch, start: int | None = None
) -> Selection:
    """The rows in which a condition holds; a line event without an anomaly is none of them.

    `start` is the wall clock (ns since 1970) at the recording's start, None if it is not known.
    """
    others = batch.others
    lines = [json_line(record) for record in others.listed]
    shown = np.array([line is not None for line in lines], np.bool_)
    listed = [line for line in lines if line is not None]
    other = np.zeros(len(others), np.bool_)
    if listed:
        other[shown] = _mask(line_columns(listed, others.t[shown], start), test)
    host, device = np.zeros(len(batch.hosts), np.bool_), np.zeros(len(batch.devices), np.bool_)
    if len(host):
        host = _mask(host_columns(protocol, batch.hosts, start), test)
    if len(device):
        device = _mask(device_columns(protocol, batch.devices, start), test)
    return Selection(host, device, other)


def _mask(rows: Columns, node: tree.Node) -> Mask:
    """In which rows a condition holds."""
    return np.broadcast_to(_true(rows, node), len(rows))


def _true(rows: Columns, node: tree.Node) -> Mask:
    match node:
        case tree.Comparison(left=left, sign=sign, right=right):
            return _compared(_operand(rows, left), sign, _operand(rows, right))
        case tree.Not(part=part):
            return ~_true(rows, part)
        case tree.Joined(every=every, parts=parts):
            return _joined(rows, parts, every)


def _joined(rows: Columns, parts: Sequence[tree.Node], every: bool) -> Mask:
    true = _true(rows, parts[0])
    for part in parts[1:]:
        if (every and not true.any()) or (not every and true.all()):
            break  # the other parts change nothing
        true = true & _true(rows, part) if every else true | _true(rows, part)
    return true


def _operand(rows: Columns, operand: tree.Operand) -> Column:
    match operand:
        case tree.Constant(value=value):
            return _constant(value)
        case tree.Name(key=key, place=place):
            return rows[key] if place is None else _item(rows[key], place)
        case tree.Bits(left=left, right=right):
            return _bits(_operand(rows, left), _operand(rows, right))


def _constant(value: float | str | bytes | frozenset[str]) -> Column:
    """A value that is the same in all rows."""
    if isinstance(value, bytes):
        data = np.frombuffer(value, np.uint8)
        return Octets(data, np.zeros((), np.int64), np.array(len(data)))
    if isinstance(value, bool | str | frozenset):
        return Words(np.zeros((), np.int64), (value,))
    return Numbers(value)


def _item(column: Column, place: int) -> Column:
    """One byte of each row."""
    if not isinstance(column, Octets):
        return column  # none of the rows has the name
    value = column.data.take(column.start + place, mode="clip")
    return Numbers(value, column.size > place)


def _bits(left: Column, right: Column) -> Numbers:
    if not (isinstance(left, Numbers) and isinstance(right, Numbers)):
        return NOTHING
    return Numbers(_whole(left) & _whole(right), _both(left.present, right.present))


def _whole(column: Numbers) -> NDArray[Any]:
    """Whole numbers as an array whose bits can be joined with those of any other."""
    value = np.asarray(column.value)
    return value if value.dtype == object else value.astype(np.int64)


def _both(left: Mask | None, right: Mask | None) -> Mask | None:
    if left is None or right is None:
        return right if left is None else left
    return left & right


def _compared(left: Column, sign: str, right: Column) -> Mask:
    """In which rows two columns have values that compare so; of several, any two of one place."""
    match left, right:
        case Numbers(), Numbers():
            true = np.asarray(_COMPARING[sign](left.value, right.value), np.bool_)
            present = _both(left.present, right.present)
            true = true if present is None else true & present
            return np.asarray(true.any(axis=0)) if true.ndim > 1 else true
        case Words(), Words():
            return _words_compared(left, _COMPARING[sign], right)
        case Octets(), Octets():
            there = np.asarray(left.size >= 0)
            if left is right:
                return there
            within = _containing if sign.endswith("contains") else _equal
            true = within(left, right.data)
            return true if sign in ("==", "contains") else there & ~true
    return np.zeros((), np.bool_)  # one side is a name that none of the rows has


def _words_compared(left: Words, compare: Callable[[Any, Any], Any], right: Words) -> Mask:
    if left is right:
        return np.array([word is not None for word in left.words]).take(left.code)
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
    return np.asarray(column.size == len(part)) & _containing(column, part)


def _containing(column: Octets, part: NDArray[np.uint8]) -> Mask:
    """In which rows the bytes contain these."""
    last = len(column.data) - len(part)
    if last < 0:
        return np.zeros(len(column.size), np.bool_)
    hits = np.ones(last + 1, np.bool_)
    for place, byte in enumerate(part.tolist()):
        hits &= column.data[place : last + 1 + place] == byte
    before = np.append(0, np.cumsum(hits))  # how many begin before each place
    first = np.minimum(column.start, last + 1)
    behind = np.clip(column.start + column.size - len(part) + 1, first, last + 1)
    return np.asarray(before.take(behind) > before.take(first))
