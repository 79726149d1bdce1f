"""What a filter means for the rows of a batch: which of them pass. Needs numpy."""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.decode.batch import (
    GARBAGE,
    INSTRUCTION,
    KINDS,
    NO_VERDICT,
    Batch,
    DeviceRows,
    HostRows,
    Mask,
    Selection,
    StateColumns,
)
from bilprov.analyzer.decode.json_lines import OUTCOME_WORDS, JsonLine, json_line
from bilprov.analyzer.filters import tree
from bilprov.analyzer.filters.fields import NONE, UNCODED, Kind, fields_of
from bilprov.analyzer.filters.tree import DATE, TIME_OF_DAY
from bilprov.analyzer.filters.values import DAY, STEP, offset
from bilprov.spec.arrays.layouts import (
    BAD_DATA,
    OUTCOMES,
    VALID,
    WIDEST,
    field_values,
    part_values,
)
from bilprov.spec.codec import Judgement, judge
from bilprov.spec.data import DataSpec, FieldSpec
from bilprov.spec.layout import Role
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import NOT_KNOWN


class Numbers(NamedTuple):
    """Numbers, or one for all rows, and in which rows there are any (None: in all).

    Where a row may have several, the first axis counts them and the last one the rows.
    """

    value: NDArray[Any] | float
    present: Mask | None = None


class Words(NamedTuple):
    """Words or the like: each row's place in `words`, of which one may be None where it lacks."""

    code: NDArray[np.integer]
    words: Sequence[Any]


class Octets(NamedTuple):
    """Bytes: of each row `size` bytes of `data` from `start` on; those with size -1 have none."""

    data: NDArray[np.uint8]
    start: NDArray[np.int64]
    size: NDArray[np.int64]


Column: TypeAlias = Numbers | Words | Octets


Makers: TypeAlias = Mapping[str, Callable[[], Column]]

NOTHING = Numbers(np.zeros((), np.int64), np.zeros((), np.bool_))
"""The column of a name that none of the rows has."""


class Columns:
    """The columns of so many rows, each made by its maker when it is asked for."""

    def __init__(self, count: int, *makers: Makers) -> None:
        self._count = count
        self._makers = {key: make for each in makers for key, make in each.items()}
        self._columns: dict[str, Column] = {}

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, key: str) -> Column:
        if key not in self._columns:
            make = self._makers.get(key)
            self._columns[key] = make() if make else NOTHING
        return self._columns[key]


def host_columns(protocol: Protocol, rows: HostRows, start: int | None) -> Columns:
    """The columns of the host's rows.

    `start` is the wall clock (ns since 1970) at the recording's start, None if it is not known.
    """
    garbage, faulty = rows.kind == GARBAGE, rows.verdict != VALID

    def length() -> Column:
        if protocol.plain:
            return _part_of(protocol, rows, "length")
        return Numbers(data().size, ~garbage)

    def data() -> Octets:
        head, tail = protocol.layout.head, protocol.layout.tail
        size = np.maximum(rows.size - head - np.where(rows.kind == INSTRUCTION, tail, 0), 0)
        return Octets(rows.data, rows.offset + head, np.where(garbage, -1, size))

    def name() -> Column:
        specs = [protocol.by_id.get(identity) for identity in protocol.keys]
        code = np.where(garbage, np.int64(len(specs)), rows.header)
        return Words(code, [spec.name if spec else None for spec in (*specs, None)])

    def reason() -> Column:
        odd = np.flatnonzero(faulty)
        return _words(rows.reasons(odd), odd, len(rows))

    makers: Makers = {
        "id": lambda: _part_of(protocol, rows, "id"),
        "len": length,
        "address": lambda: _part_of(protocol, rows, "address"),
        "hex": lambda: Octets(rows.data, rows.offset, rows.size),
        "data": data,
        "direction": lambda: _one("host"),
        "kind": lambda: Words(rows.kind, KINDS),
        "name": name,
        "faulty": lambda: _truth(faulty),
        "reason": reason,
        "sequence": lambda: Numbers(rows.sequence, rows.sequence >= 0),
        "uncertain": lambda: _truth(rows.uncertain),
    }

    def one_by_one(found: NDArray[np.int64]) -> Iterator[Judgement]:
        return (judge(protocol, frame) for frame in rows.frames(found))

    def register(name: str) -> Column:
        writing = [protocol.key_of(spec.id) for spec in protocol.instructions if spec.writes]
        found = np.flatnonzero((rows.kind == INSTRUCTION) & np.isin(rows.header, writing))
        return _told(name, (one.values for one in one_by_one(found)), found, len(rows))

    fields = _of_fields(protocol, partial(_requests, protocol, rows), rows.data, len(rows))
    fields = {**fields, **_of_registers(protocol, register)}
    judged = _of_judgements(protocol, rows, rows.due, one_by_one)
    both = (judged, _of_time(rows.t, start), _of_state(rows.states))
    return Columns(len(rows), makers, fields, *both)


def device_columns(protocol: Protocol, rows: DeviceRows, start: int | None) -> Columns:
    """The columns of the device's rows."""
    answers = rows.answers

    def name() -> Column:
        return Words(answers.name, answers.names)

    def address() -> Column:
        return Numbers(answers.address, answers.address >= 0)

    def octets() -> Column:
        return Octets(answers.data, answers.offset, answers.size)

    def faulty() -> Column:
        return _truth(rows.answering & (rows.verdict != VALID) | rows.faults.serious)

    def reason() -> Column:
        odd = np.flatnonzero(rows.odd)
        return _words((record.reason for record in rows.samples(odd)), odd, len(rows))

    def response() -> Column:
        named = np.array([word is not None for word in answers.names]).take(answers.name)
        return Numbers(rows.byte, (rows.byte >= 0) | named)

    def uncertain() -> Column:
        mask, odd = np.zeros(len(rows), np.bool_), np.flatnonzero(rows.odd)
        mask[odd] = [record.uncertain for record in rows.samples(odd)]
        return _truth(mask)

    makers: Makers = {
        "address": address,
        "hex": octets,
        "direction": lambda: _one("device"),
        "kind": lambda: _one("response"),
        "name": name,
        "response": response,
        "faulty": faulty,
        "reason": reason,
        "answers": lambda: Numbers(rows.sequence, rows.answering),
        "latency": lambda: Numbers(rows.latency / 1e9, rows.answering),
        "latency_ns": lambda: Numbers(rows.latency, rows.answering),
        "agrees": lambda: Words(rows.agrees + 1, (None, False, True)),
        "uncertain": uncertain,
    }

    def one_by_one(found: NDArray[np.int64]) -> Iterator[Judgement]:
        answered = (record.answered for record in rows.samples(found))
        return (one for one in answered if one is not None)

    def register(name: str) -> Column:
        reading = [protocol.key_of(spec.id) for spec in protocol.instructions if spec.reads]
        found = np.flatnonzero(rows.answering & np.isin(rows.header, reading))
        replies = (record.reply for record in rows.samples(found))
        return _told(name, (one.values if one else () for one in replies), found, len(rows))

    fields = _of_fields(protocol, partial(_answers, protocol, rows), answers.data, len(rows))
    fields = {**fields, **_of_registers(protocol, register)}
    judged = _of_judgements(protocol, rows, None, one_by_one)
    both = (judged, _of_time(rows.t, start), _of_state(rows.states))
    return Columns(len(rows), makers, fields, *both)


def line_columns(lines: Sequence[JsonLine], t: NDArray[np.int64], start: int | None) -> Columns:
    """The columns of the other rows, which are few: each is a JSON line, and came at `t` (ns)."""
    none = np.zeros(len(lines), np.int64)

    def listed(value: Callable[[JsonLine], Any]) -> Callable[[], Column]:
        return lambda: _listed([value(line) for line in lines])

    kinds = [type(line.state) for line in lines[:1]]
    states = [f"state.{name}" for kind in kinds for name in kind.__struct_fields__]
    as_they_are = ("direction", "kind", "name", "reason", "sequence", *states)
    makers: Makers = {
        **{name: listed(attrgetter(name)) for name in as_they_are},
        "hex": lambda: Octets(np.zeros(1, np.uint8), none, none),
        "faulty": listed(lambda line: bool(line.faults)),
        "faults": listed(lambda line: frozenset(line.faults)),
    }
    return Columns(len(lines), makers, _of_time(t, start))


def _of_judgements(
    protocol: Protocol,
    rows: HostRows | DeviceRows,
    due: Mask | None,
    one_by_one: Callable[[NDArray[np.int64]], Iterable[Judgement]],
) -> Makers:
    """What tells how an instruction is judged: the row's own, or the one that it answers.

    `due` tells to which an answer is due (None: to each), and `one_by_one` judges some rows, which
    is done to those that are faulty where the verdict alone does not tell their answer.
    """
    there = rows.verdict != NO_VERDICT
    parts = [part for spec in protocol.instructions for part in spec.fields]
    by_verdict = protocol.plain and not any(part.code for part in parts)
    odd = np.flatnonzero(there & (rows.verdict != VALID) & (not by_verdict))

    def judgement() -> Column:
        codes = [*(protocol.answers[outcome].code for outcome in OUTCOMES), NONE]
        code = np.array(codes).take(rows.verdict)
        valid = rows.verdict == VALID
        code[np.isin(rows.header, list(protocol.uncoded)) & valid] = UNCODED
        if due is not None:
            code[~due] = NONE
        judged = [one.response if one.answer_due else None for one in one_by_one(odd)]
        code[odd] = [NONE if response is None else response.code for response in judged]
        return Numbers(code, there if not protocol.plain else code >= 0)

    def outcome() -> Column:
        code = rows.verdict.copy()
        cut_short = [one.truncated for one in one_by_one(odd)]
        code[odd[cut_short]] = len(OUTCOMES)
        return Words(np.where(there, code, len(OUTCOME_WORDS)), (*OUTCOME_WORDS, None))

    def faults() -> Column:
        return Words(rows.faults.code, list(map(frozenset, rows.faults.kinds)))

    return {"judgement": judgement, "outcome": outcome, "faults": faults}


def _of_time(t: NDArray[np.int64], start: int | None) -> Makers:
    """The times of the rows (ns)."""
    since: Makers = {"t": lambda: Numbers(t / 1e9), "t_ns": lambda: Numbers(t)}
    if start is None:
        return since

    def time_of_day() -> Column:
        step, place = np.unique((t + start) // STEP, return_inverse=True)
        offsets = np.array([offset(one) for one in step.tolist()], np.int64)
        return Numbers((t + start + offsets[place]) % DAY)

    return {**since, DATE: lambda: Numbers(t + start), TIME_OF_DAY: time_of_day}


def _of_state(states: StateColumns) -> Makers:
    """The variables of the predicted state, and whether the device moves."""

    def variable(name: str) -> Column:
        column, words = states[name], states.kind.words.get(name)
        known = column != NOT_KNOWN
        if words is None:
            return Numbers(column, known)
        return Words(np.where(known, column, len(words)), (*words, None))

    kind = states.kind
    makers: Makers = {f"state.{name}": partial(variable, name) for name in kind.variables}
    if kind.at_rest is None:
        return makers
    return {**makers, "state.moving": lambda: _truth(states.moving)}


def _part_of(protocol: Protocol, rows: HostRows, role: Role) -> Column:
    """A part of the frames, where what stands before the data is whole."""
    layout = protocol.layout
    part = layout.part(role)
    there = (rows.kind != GARBAGE) & (rows.size >= layout.head)
    if part is None or part.size > WIDEST:
        return NOTHING
    found = np.flatnonzero(there)
    value = np.zeros(len(rows), np.int64)
    start = rows.offset[found]
    value[found] = part_values(part, rows.data, start, start + rows.size[found])
    return Numbers(value, there)


class _Carried(NamedTuple):
    """Which rows carry fields: the rows, and where their data begin and how many bytes they are."""

    rows: NDArray[np.int64]
    at: NDArray[np.int64]
    size: NDArray[np.int64]


def _requests(protocol: Protocol, rows: HostRows) -> Iterator[tuple[DataSpec, _Carried]]:
    """The data of each instruction that has some, and the rows with it."""
    head, tail = protocol.layout.head, protocol.layout.tail
    judged = (rows.kind == INSTRUCTION) & np.isin(rows.verdict, (VALID, BAD_DATA))
    for spec in protocol.instructions:
        if spec.fields:
            found = np.flatnonzero(judged & (rows.header == protocol.key_of(spec.id)))
            size = rows.size[found] - head - tail
            yield spec, _Carried(found, rows.offset[found] + head, size)


def _answers(protocol: Protocol, rows: DeviceRows) -> Iterator[tuple[DataSpec, _Carried]]:
    """The data of the answers to each instruction, and the rows with them."""
    answers = rows.answers
    there = answers.fields_size >= 0
    found = [
        (spec.answer, np.flatnonzero(there & rows.answering & (rows.header == key)))
        for spec in protocol.instructions
        if spec.answer and spec.answer.fields
        for key in (protocol.key_of(spec.id),)
    ]
    unasked = np.flatnonzero(there & ~rows.answering)
    ways = [record.reply.way if record.reply else None for record in rows.samples(unasked)]
    kinds = {id(way.data): way.data for way in ways if way and way.data}
    found += [
        (data, unasked[[bool(way and way.data is data) for way in ways]]) for data in kinds.values()
    ]
    for data, those in found:
        yield data, _Carried(those, answers.fields_at[those], answers.fields_size[those])


def _of_fields(
    protocol: Protocol,
    carried: Callable[[], Iterable[tuple[DataSpec, _Carried]]],
    data: NDArray[np.uint8],
    count: int,
) -> Makers:
    """The fields of the rows of one side, by their keys."""

    def made(name: str, *, as_bytes: bool) -> Column:
        parts = [
            (part, part is spec.fields[-1] and spec.counted is not None, these)
            for spec, these in carried()
            for part in spec.fields
            if part.name == name and part.constant is None
        ]
        return (_octets if as_bytes else _numbers)(parts, data, count)

    known = {name: field for name, field in fields_of(protocol).items() if name == field.key}
    return {
        key: partial(made, key.removeprefix("fields."), as_bytes=field.kind is Kind.BYTES)
        for key, field in known.items()
        if key.startswith("fields.")
    }


def _of_registers(protocol: Protocol, made: Callable[[str], Column]) -> Makers:
    """The named registers by their keys."""
    return {f"fields.{name}": partial(made, name) for name in protocol.named_registers}


def _told(
    name: str, told: Iterable[Iterable[tuple[str, Any]]], rows: NDArray[np.int64], count: int
) -> Column:
    """A register that some rows may tell; those are decoded one by one.

    A row that writes it at several devices has several values.
    """
    found = [[(one.partition("@")[0], value) for one, value in fields] for fields in told]
    counts = [Counter(one for one, _ in fields) for fields in found]
    most = max((max(each.values(), default=1) for each in counts), default=1)
    value, present = np.zeros((most, count), object), np.zeros((most, count), np.bool_)
    for row, fields in zip(rows.tolist(), found, strict=True):
        values = [value for one, value in fields if one == name]
        value[: len(values), row] = values
        present[: len(values), row] = True
    return Numbers(value, present)


_Parts: TypeAlias = Sequence[tuple[FieldSpec, bool, _Carried]]
"""A field with its rows, and whether it goes to the end of the data."""


def _numbers(parts: _Parts, data: NDArray[np.uint8], count: int) -> Column:
    """A field that is a number wherever it is one."""
    value, present = np.zeros(count, np.int64), np.zeros(count, np.bool_)
    for part, _, carried in parts:
        values = field_values(part, data, carried.at)
        if values.dtype.kind != "i":  # wider than 64 bits with a sign
            value = value.astype(object)
        value[carried.rows] = values
        present[carried.rows] = True
    return Numbers(value, present)


def _octets(parts: _Parts, data: NDArray[np.uint8], count: int) -> Column:
    """The bytes of a field that is bytes, or several numbers, somewhere."""
    start, size = np.zeros(count, np.int64), np.full(count, -1, np.int64)
    for part, to_end, carried in parts:
        before = part.many.prefix.size if part.many and part.many.prefix else 0
        start[carried.rows] = carried.at + part.offset + before
        whole = carried.size - part.offset if to_end else part.size
        size[carried.rows] = np.maximum(whole - before, 0)
    return Octets(data, start, size)


def _listed(values: Sequence[Any]) -> Column:
    """A column of values of one kind."""
    numbers = [type(value) is int for value in values]
    if any(numbers):
        return Numbers(np.array([value or 0 for value in values]), np.array(numbers))
    return _words(values, np.arange(len(values)), len(values), None)


def _truth(mask: Mask) -> Words:
    return Words(mask.view(np.uint8), (False, True))


def _one(word: str) -> Words:
    return Words(np.zeros((), np.int64), (word,))


def _words(
    values: Iterable[Hashable], rows: NDArray[np.int64], count: int, others: Hashable = ""
) -> Words:
    """A column with these values in some of `count` rows, and `others` in all others."""
    places = {others: 0}
    code = np.zeros(count, np.int64)
    code[rows] = [places.setdefault(value, len(places)) for value in values]
    return Words(code, list(places))


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
        case tree.Bits(left=left, mask=mask):
            return _bits(_operand(rows, left), mask)


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


def _bits(column: Column, mask: int) -> Numbers:
    if not isinstance(column, Numbers):
        return NOTHING
    value = np.asarray(column.value)
    whole = value if value.dtype == object else value.astype(np.int64)
    return Numbers(whole & mask, column.present)


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
