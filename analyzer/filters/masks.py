"""What a filter means for the rows of a batch: which of them pass. Needs numpy.

A row that lacks a value passes no comparison with it.
"""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.decode import batch as batches
from bilprov.analyzer.decode.batch import Batch, DeviceRows, HostRows, Mask, Selection
from bilprov.analyzer.decode.json_lines import OUTCOME_WORDS, JsonLine, json_line
from bilprov.analyzer.filters.fields import DAY, NONE, STEP, UNCODED, Kind, fields_of, offset
from bilprov.spec.arrays import layouts
from bilprov.spec.arrays.layouts import BAD_DATA, OUTCOMES, VALID, WIDEST
from bilprov.spec.codec import Judgement
from bilprov.spec.data import DataSpec
from bilprov.spec.layout import Role
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import Reply
from bilprov.spec.state import NOT_KNOWN

TIME_OF_DAY, DATE = "time of day", "time"
"""The keys of a row's wall clock in ns: since local midnight, and since 1970."""


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
Columns: TypeAlias = Callable[[str], Column]
"""Gives the column of a key, the same one each time."""

NOTHING = Numbers(np.zeros((), np.int64), np.zeros((), np.bool_))
"""The column of a name that none of the rows has."""


def _columns(*makers: Makers) -> Columns:
    """The columns of some rows, each made when it is asked for."""
    known = {key: make for each in makers for key, make in each.items()}

    @cache
    def column(key: str) -> Column:
        return known[key]() if key in known else NOTHING

    return column


def _host_columns(protocol: Protocol, rows: HostRows, start: int | None) -> Columns:
    """The columns of the host's rows."""
    garbage, head = rows.kind == batches.GARBAGE, protocol.layout.head

    def length() -> Column:
        return (
            _part_of(protocol, rows, "length") if protocol.plain else Numbers(data().size, ~garbage)
        )

    def data() -> Octets:
        tails = np.array([protocol.layout.of(identity).tail for identity in protocol.keys])
        tail = np.where(rows.kind == batches.INSTRUCTION, tails.take(rows.header), 0)
        size = np.maximum(rows.size - head - tail, 0)
        return Octets(rows.data, rows.offset + head, np.where(garbage, -1, size))

    def name() -> Column:
        specs = [protocol.by_id.get(identity) for identity in protocol.keys]
        code = np.where(garbage, np.int64(len(specs)), rows.header)
        return Words(code, [spec.name if spec else None for spec in (*specs, None)])

    def carried() -> Iterator[_Carried]:
        judged = (rows.kind == batches.INSTRUCTION) & np.isin(rows.verdict, (VALID, BAD_DATA))
        for spec in protocol.instructions:
            if spec.fields:
                found = np.flatnonzero(judged & (rows.header == protocol.key_of(spec.id)))
                size = rows.size[found] - head - protocol.layout.of(spec.id).tail
                yield _Carried(spec, found, rows.offset[found] + head, size)

    own: Makers = {
        "id": partial(_part_of, protocol, rows, "id"),
        "len": length,
        "address": partial(_part_of, protocol, rows, "address"),
        "data": data,
        "direction": lambda: _one("host"),
        "kind": lambda: Words(rows.kind, batches.KINDS),
        "name": name,
        "faulty": lambda: _truth(rows.verdict != VALID),
        "sequence": lambda: Numbers(rows.sequence, rows.sequence >= 0),
    }
    odd = (rows.verdict != VALID) | rows.uncertain
    judged = _of_judgements(protocol, rows, rows.due, attrgetter("judgement"))
    writing = [protocol.key_of(spec.id) for spec in protocol.instructions if spec.writes]
    told = rows.kind == batches.INSTRUCTION, writing, attrgetter("judgement")
    fields = _of_fields(protocol, rows, carried, *told)
    return _columns(own, _of_both(rows, odd, start), judged, fields)


def _device_columns(protocol: Protocol, rows: DeviceRows, start: int | None) -> Columns:
    """The columns of the device's rows."""
    there = rows.fields_size >= 0

    def response() -> Column:
        named = np.array([word is not None for word in rows.names]).take(rows.name)
        return Numbers(rows.byte, (rows.byte >= 0) | named)

    def carried() -> Iterator[_Carried]:
        for spec in protocol.instructions:
            if spec.answer and spec.answer.fields:
                key = protocol.key_of(spec.id)
                yield of(spec.answer, np.flatnonzero(there & rows.answering & (rows.header == key)))
        unasked = np.flatnonzero(there & ~rows.answering)
        ways = [
            one.reply.way.data if one.reply and one.reply.way else None
            for one in rows.samples(unasked)
        ]
        for data in {id(data): data for data in ways if data}.values():
            yield of(data, unasked[[one is data for one in ways]])

    def of(data: DataSpec, found: NDArray[np.int64]) -> _Carried:
        return _Carried(data, found, rows.fields_at[found], rows.fields_size[found])

    own: Makers = {
        "address": lambda: Numbers(rows.address, rows.address >= 0),
        "direction": lambda: _one("device"),
        "kind": lambda: _one("response"),
        "name": lambda: Words(rows.name, rows.names),
        "response": response,
        "faulty": lambda: _truth(rows.answering & (rows.verdict != VALID) | rows.faults.serious),
        "answers": lambda: Numbers(rows.sequence, rows.answering),
        "latency": lambda: Numbers(rows.latency / 1e9, rows.answering),
        "latency_ns": lambda: Numbers(rows.latency, rows.answering),
        "agrees": lambda: Words(rows.agrees + 1, (None, False, True)),
    }
    judged = _of_judgements(protocol, rows, None, attrgetter("answered"))
    reading = [protocol.key_of(spec.id) for spec in protocol.instructions if spec.reads]
    fields = _of_fields(protocol, rows, carried, rows.answering, reading, attrgetter("reply"))
    return _columns(own, _of_both(rows, rows.odd, start), judged, fields)


def _line_columns(lines: Sequence[JsonLine], t: NDArray[np.int64], start: int | None) -> Columns:
    """The columns of the other rows, which are few: each is a JSON line, and came at `t` (ns)."""
    none = np.zeros(len(lines), np.int64)

    def listed(key: str) -> Column:
        values = [attrgetter(key)(line) for line in lines]
        numbers = [type(value) is int for value in values]
        if any(numbers):
            return Numbers(np.array([value or 0 for value in values]), np.array(numbers))
        return _words(values, np.arange(len(values)), len(values), None)

    states = [f"state.{name}" for name in lines[0].state.__struct_fields__]
    own: Makers = {
        **{
            key: partial(listed, key)
            for key in ("direction", "kind", "name", "reason", "sequence", *states)
        },
        "hex": lambda: Octets(np.zeros(1, np.uint8), none, none),
        "faulty": lambda: _truth(np.array([bool(line.faults) for line in lines])),
        "faults": lambda: _words(
            [frozenset(line.faults) for line in lines], np.arange(len(lines)), len(lines)
        ),
    }
    return _columns(own, _of_time(t, start))


def _of_both(rows: HostRows | DeviceRows, odd: Mask, start: int | None) -> Makers:
    """What the rows of both sides have: times, the state, and what is said of `odd` rows alone."""
    found, states = np.flatnonzero(odd), rows.states
    words = states.kind.words

    def reason() -> Column:
        return _words((record.reason for record in rows.samples(found)), found, len(rows))

    def uncertain() -> Column:
        mask = np.zeros(len(rows), np.bool_)
        mask[found] = [record.uncertain for record in rows.samples(found)]
        return _truth(mask)

    def variable(name: str) -> Column:
        column = states[name]
        known = column != NOT_KNOWN
        if name not in words:
            return Numbers(column, known)
        return Words(np.where(known, column, len(words[name])), (*words[name], None))

    makers: Makers = {
        "hex": lambda: Octets(rows.data, rows.offset, rows.size),
        "reason": reason,
        "uncertain": uncertain,
        "faults": lambda: Words(rows.faults.code, list(map(frozenset, rows.faults.kinds))),
        **{f"state.{name}": partial(variable, name) for name in states.kind.variables},
        **_of_time(rows.t, start),
    }
    if states.kind.at_rest is None:
        return makers
    return {**makers, "state.moving": lambda: _truth(states.moving)}


def _of_judgements(
    protocol: Protocol,
    rows: HostRows | DeviceRows,
    due: Mask | None,
    judgement_of: Callable[[Any], Judgement],
) -> Makers:
    """What tells how an instruction is judged: the row's own, or the one that it answers.

    `due` tells to which an answer is due (None: to each). The records of those that are faulty are
    asked where the verdict alone does not tell their answer.
    """
    there = rows.verdict != batches.NO_VERDICT
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
        judged = map(judgement_of, rows.samples(odd))
        code[odd] = [one.response.code if one.answer_due else NONE for one in judged]
        return Numbers(code, there if not protocol.plain else code >= 0)

    def outcome() -> Column:
        code = rows.verdict.copy()
        code[odd[[one.truncated for one in map(judgement_of, rows.samples(odd))]]] = len(OUTCOMES)
        return Words(np.where(there, code, len(OUTCOME_WORDS)), (*OUTCOME_WORDS, None))

    return {"judgement": judgement, "outcome": outcome}


def _of_time(t: NDArray[np.int64], start: int | None) -> Makers:
    """The times of the rows (ns).

    `start` is the wall clock (ns since 1970) at the recording's start, None if it is not known.
    """
    since: Makers = {"t": lambda: Numbers(t / 1e9), "t_ns": lambda: Numbers(t)}
    if start is None:
        return since

    def time_of_day() -> Column:
        step, place = np.unique((t + start) // STEP, return_inverse=True)
        offsets = np.array([offset(one) for one in step.tolist()], np.int64)
        return Numbers((t + start + offsets[place]) % DAY)

    return {**since, DATE: lambda: Numbers(t + start), TIME_OF_DAY: time_of_day}


def _part_of(protocol: Protocol, rows: HostRows, role: Role) -> Column:
    """A part of the frames, where what stands before the data is whole."""
    layout = protocol.layout
    part = layout.part(role)
    there = (rows.kind != batches.GARBAGE) & (rows.size >= layout.head)
    if part is None or part.size > WIDEST:
        return NOTHING
    found = np.flatnonzero(there)
    value = np.zeros(len(rows), np.int64)
    start = rows.offset[found]
    value[found] = layouts.part_values(part, rows.data, start, start + rows.size[found])
    return Numbers(value, there)


class _Carried(NamedTuple):
    """Rows that carry the fields of `spec`, where these begin, and in how many bytes they are."""

    spec: DataSpec
    rows: NDArray[np.int64]
    at: NDArray[np.int64]
    size: NDArray[np.int64]


def _of_fields(
    protocol: Protocol,
    of: HostRows | DeviceRows,
    carried: Callable[[], Iterable[_Carried]],
    whole: Mask,
    headers: list[int],
    telling: Callable[[Any], Judgement | Reply | None],
) -> Makers:
    """The fields of the rows of one side by their keys, and the named registers.

    Those that are `whole` and have one of the `headers` may tell registers: what of their records
    is `telling`.
    """
    count, data = len(of), of.data

    def made(name: str, kind: Kind) -> Column:
        value, present = np.zeros(count, np.int64), np.zeros(count, np.bool_)
        start, size = np.zeros(count, np.int64), np.full(count, -1, np.int64)
        for spec, rows, at, many in carried():
            for part in spec.fields:
                if part.name != name or part.constant is not None:
                    continue
                if kind is Kind.BYTES:
                    before = part.many.prefix.size if part.many and part.many.prefix else 0
                    to_end = part is spec.fields[-1] and spec.counted is not None
                    start[rows] = at + part.offset + before
                    size[rows] = np.maximum(
                        (many - part.offset if to_end else part.size) - before, 0
                    )
                    continue
                values = layouts.field_values(part, data, at)
                if values.dtype.kind != "i":  # wider than 64 bits with a sign
                    value = value.astype(object)
                value[rows], present[rows] = values, True
        return Octets(data, start, size) if kind is Kind.BYTES else Numbers(value, present)

    def register(name: str) -> Column:
        """A register; a row that writes it at several devices has several values."""
        rows = np.flatnonzero(whole & np.isin(of.header, headers))
        values = [one.values if one else () for one in map(telling, of.samples(rows))]
        told = [[(key.partition("@")[0], value) for key, value in one] for one in values]
        counts = [Counter(key for key, _ in one) for one in told]
        most = max((max(each.values(), default=1) for each in counts), default=1)
        value, present = np.zeros((most, count), object), np.zeros((most, count), np.bool_)
        for row, one in zip(rows.tolist(), told, strict=True):
            found = [value for key, value in one if key == name]
            value[: len(found), row] = found
            present[: len(found), row] = True
        return Numbers(value, present)

    return {
        **{
            key: partial(made, key.removeprefix("fields."), field.kind)
            for key, field in fields_of(protocol).items()
            if key.startswith("fields.")
        },
        **{f"fields.{name}": partial(register, name) for name in protocol.named_registers},
    }


def _truth(mask: Mask) -> Words:
    return Words(mask.view(np.uint8), (False, True))


def _one(word: Hashable) -> Words:
    return Words(np.zeros((), np.int64), (word,))


def _words(
    values: Iterable[Hashable], rows: NDArray[np.int64], count: int, others: Hashable = ""
) -> Words:
    """A column with these values in some of `count` rows, and `others` in all others."""
    places = {others: 0}
    code = np.zeros(count, np.int64)
    code[rows] = [places.setdefault(value, len(places)) for value in values]
    return Words(code, list(places))


Operand: TypeAlias = Callable[[Columns], Column]
"""What a filter asks of rows."""

Test: TypeAlias = Callable[[Columns], Mask]
"""A condition: in which rows it holds."""


def selection(test: Test, protocol: Protocol, batch: Batch, start: int | None) -> Selection:
    """The rows in which a condition holds; a line event without an anomaly is none of them.

    `start` is the wall clock (ns since 1970) at the recording's start, None if it is not known.
    """
    hosts, devices, others = batch.hosts, batch.devices, batch.others
    masks = [np.zeros(len(rows), np.bool_) for rows in (hosts, devices, others)]
    lines = [json_line(record) for record in others.listed]
    shown = np.array([line is not None for line in lines], np.bool_)
    if shown.any():
        listed = [line for line in lines if line is not None]
        masks[2][shown] = test(_line_columns(listed, others.t[shown], start))
    if len(hosts):
        masks[0][:] = test(_host_columns(protocol, hosts, start))
    if len(devices):
        masks[1][:] = test(_device_columns(protocol, devices, start))
    return Selection(*masks)


def joined(tests: Sequence[Test], every: bool) -> Test:
    """The condition that all of these hold, or (`every` is false) at least one."""

    def holds(rows: Columns) -> Mask:
        true = tests[0](rows)
        for test in tests[1:]:
            if (every and not true.any()) or (not every and true.all()):
                break  # the others change nothing
            true = true & test(rows) if every else true | test(rows)
        return true

    return holds if len(tests) > 1 else tests[0]


def negated(test: Test) -> Test:
    """The condition that holds where another does not."""
    return lambda rows: ~test(rows)


def of_row(key: str, place: int | None = None) -> Operand:
    """A value of the row: that of a Field's `key`, TIME_OF_DAY or DATE; with a `place` its byte."""

    def column(rows: Columns) -> Column:
        found = rows(key)
        if place is None or not isinstance(found, Octets):  # or none of the rows has the name
            return found
        return Numbers(found.data.take(found.start + place, mode="clip"), found.size > place)

    return column


def masked(operand: Operand, mask: int) -> Operand:
    """The bits that a whole number of the row has of a mask."""

    def column(rows: Columns) -> Column:
        found = operand(rows)
        if not isinstance(found, Numbers):
            return NOTHING
        value = np.asarray(found.value)
        whole = value if value.dtype == object else value.astype(np.int64)
        return Numbers(whole & mask, found.present)

    return column


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


def alike(left: Operand, sign: str, right: Operand) -> Test:
    """The condition that two values of the row compare so."""
    return lambda rows: _compared(left(rows), sign, right(rows))


def compared(operand: Operand, sign: str, value: float | str | bytes | frozenset[str]) -> Test:
    """The condition that a value of the row compares so with one that is the same in all rows.

    `sign` is one of `== != < <= > >=`, or behind words, text and bytes `contains`, `not contains`.
    """
    right: Column
    if isinstance(value, bytes):
        data = np.frombuffer(value, np.uint8)
        right = Octets(data, np.zeros((), np.int64), np.array(len(data)))
    elif isinstance(value, bool | str | frozenset):
        right = _one(value)
    else:
        right = Numbers(value)
    return lambda rows: _compared(operand(rows), sign, right)


def _compared(left: Column, sign: str, right: Column) -> Mask:
    """In which rows two columns have values that compare so; of several, any two of one place."""
    match left, right:
        case Numbers(), Numbers():
            true = np.asarray(_COMPARING[sign](left.value, right.value), np.bool_)
            for present in (left.present, right.present):
                true = true if present is None else true & present
            return np.asarray(true.any(axis=0)) if true.ndim > 1 else true
        case Words(), Words():
            return _words_compared(left, _COMPARING[sign], right)
        case Octets(), Octets():
            there = np.asarray(left.size >= 0)
            if left is right:
                return there
            true = _containing(left, right.data)
            if not sign.endswith("contains"):
                true &= left.size == len(right.data)
            return true if sign in ("==", "contains") else there & ~true
    return np.zeros((), np.bool_)  # one side is a name that none of the rows has


def _words_compared(left: Words, compare: Callable[[Any, Any], Any], right: Words) -> Mask:
    if left is right:
        return np.array([word is not None for word in left.words]).take(left.code)
    table = np.zeros((len(left.words), len(right.words)), np.bool_)
    for place in np.ndindex(table.shape):
        one, other = left.words[place[0]], right.words[place[1]]
        table[place] = one is not None and other is not None and compare(one, other)
    if right.code.ndim == 0:
        return table[:, int(right.code)].take(left.code)
    return np.asarray(table[left.code, right.code])


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
