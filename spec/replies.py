"""Frames that a device answers with: where they end, what they hold, and how they are built."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import msgspec
from msgspec.structs import replace

from bilprov.spec.codec import Judgement, Registers, data_bytes, field_words, registers_in
from bilprov.spec.data import DataSpec, FieldSpec
from bilprov.spec.fields import Outcome, codes_in
from bilprov.spec.layout import Layout
from bilprov.spec.protocol import NO_ANSWER, PLAIN_ANSWER, InstructionSpec, Protocol, ResponseSpec
from bilprov.spec.state import Assigned

GIVES_UP = 5
"""The part of an answer's deadline after which a host that sends another request has given up."""


class Way(NamedTuple):
    """One way in which an answer can be laid out; `data` is None where only the request tells."""

    layout: Layout
    data: DataSpec | None


class Reply(msgspec.Struct, frozen=True, gc=False):
    """One answer of a device.

    `response` is what its code means, None for an unused code; of several flags the first that
    stands for an outcome. `names` are those of all. `way` is how it is laid out, None for bytes
    that are no answer. `fields` are its data, `address` is whose it is. `reason` tells why the
    answer is damaged, "" for one that is not. With `open_end` nothing but silence tells where it
    ends. `registers` are the named registers that it tells, as in a Judgement.
    """

    framed: ClassVar[bool] = True

    frame: bytes
    response: ResponseSpec | None
    names: tuple[str, ...]
    way: Way | None
    fields: tuple[tuple[str, Any], ...] = ()
    address: int | None = None
    reason: str = ""
    open_end: bool = False
    registers: Registers = ()

    @property
    def head(self) -> int:
        """The bytes before its data."""
        return self.way.layout.head if self.way else 0

    @property
    def tail(self) -> int:
        """The bytes behind its data."""
        return self.way.layout.tail if self.way else 0

    @property
    def values(self) -> tuple[tuple[str, Any], ...]:
        """The values of its fields and of its registers, by name."""
        named = ((one.name, value) for one, value in self.registers)
        return (*self.fields, *named) if self.registers else self.fields

    @property
    def told(self) -> tuple[tuple[str, Any], ...]:
        """The same in words: the name of a named value, and the names of the flags that are set."""
        return tuple((spec.name, spec.in_words(value)) for spec, value in self._named)

    @property
    def _named(self) -> Registers:
        """The values, each with what its field or register is."""
        data = (self.way and self.way.data) or DataSpec()
        specs = {spec.name: spec for spec in data.fields}
        return (*((specs[name], value) for name, value in self.fields), *self.registers)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.frame.hex(' ')}: {self.describe()}>"

    def describe(self) -> str:
        """The answer in words: its names, its fields and its registers."""
        to = f"@{self.address} " if self.address is not None else ""
        known = " ".join(self.names) or (self.response.name if self.response else "unreadable")
        more = len(self.frame) - self.head - self.tail if self.response and not self.fields else 0
        data = f", {data_bytes(more)}" if more > 0 else ""
        shown = [field_words(spec, value) for spec, value in self._named]
        return to + " ".join([known, *shown]) + data

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """What it stands for; none for the device's own condition, or an unused code."""
        return self.response.outcomes if self.response else ()


def asked_values(protocol: Protocol, asked: Judgement | None) -> dict[str, Any]:
    """The parts and the fields of a request by name, which its answer may repeat or count by."""
    if asked is None:
        return {}
    parts = protocol.layout.values(asked.frame) if not asked.truncated else {}
    return {**parts, **dict(asked.fields)}


def reply_size(protocol: Protocol, held: bytes, asked: Judgement | None) -> int | None:
    """How many bytes the answer has that begins so; None: not known yet, -1: it can be none.

    `asked` is the request that it answers, None if there is none.
    """
    values = asked_values(protocol, asked)
    first = -1
    for way in _ways(protocol, asked, held):
        size = _size(protocol, way, held, asked, values)
        if size is None or size > len(held):
            return size
        if size > 0 and _is_right(protocol, way, held[:size], asked):
            return size
        if size > 0 > first:
            first = size
    return first


def read_reply(
    protocol: Protocol, frame: bytes, asked: Judgement | None, *, alone: bool = False
) -> Reply:
    """Read one answer, whole or damaged, to a request (None if there is none).

    With `alone` no request was heard: what only that tells is left open.
    """
    values = asked_values(protocol, asked)
    found: Reply | None = None
    for way in _ways(protocol, asked, frame):
        layout = way.layout
        size = _size(protocol, way, frame, asked, values)
        open_end = alone and size is None and len(frame) >= layout.head + layout.tail
        if size == len(frame) or open_end:
            right = _is_right(protocol, way, frame, asked)
            if right or not found:
                reason = _damage(protocol, layout, frame, asked)
                found = read_as(protocol, way, frame, asked, reason)
                if open_end and (layout.check is None or layout.check.asked):
                    found = replace(found, open_end=True)
            if right:
                break
    if found:
        return found
    usual = _ways(protocol, asked, frame)[0].layout
    wrong = "" if usual.begins(frame) else usual.wrong_constant(frame)
    unrepeated = usual.unrepeated(frame, values) if values else None
    if unrepeated and not wrong:
        part, due = unrepeated
        wrong = f"{part.name} is {part.read(frame)}, right is {due}"
    return Reply(frame, None, (), None, reason=wrong or "the bytes are not an answer")


def read_as(
    protocol: Protocol, way: Way, frame: bytes, asked: Judgement | None, reason: str = ""
) -> Reply:
    """Read an answer that is laid out in this way; the data of one that is damaged are left out.

    `asked` is its request, None if there is none, and `reason` tells how it is damaged.
    """
    values = asked_values(protocol, asked)
    layout = way.layout
    names, response = meaning(protocol, layout.value("code", frame))
    to = layout.part("address")
    fields: tuple[tuple[str, Any], ...] = ()
    registers: Registers = ()
    if layout.has_data and way.data is not None and not reason:
        data = layout.data_of(frame)
        needed = way.data.measure(data, values)
        has_some = bool(data) or response is None or Outcome.VALID in response.outcomes
        if has_some and (needed == len(data) or way.data.takes_rest):
            fields = tuple(way.data.decode(data).items())
            told = asked.instruction.reads if asked and asked.instruction else None
            registers = registers_in(protocol, told, way.data, data, values)
        elif has_some:
            reason = f"it has {len(data)} data bytes, {needed} are due"
    address = to.repeated(to.read(frame)) if to else None
    return Reply(frame, response, names, way, fields, address, reason, registers=registers)


def build_reply(
    protocol: Protocol, asked: Judgement, values: Mapping[str, Any] | None = None
) -> bytes:
    """Build the answer to a request, with the response that it is judged to get; b"" for none.

    `values` are the fields of its data (what is not given is 0, or empty). An error lacks its data
    where a length tells that.
    """
    response = asked.response
    if response is NO_ANSWER:
        return b""
    way = _way_of(protocol, asked, response)
    values = values or {}
    parts = asked_values(protocol, asked)
    data = b""
    lacking = Outcome.VALID not in response.outcomes and way.layout.part("length") is not None
    if way.layout.has_data and way.data is not None and not lacking:
        data = _filled(way.data, parts, values)
    told = {
        part.name: part.repeating(parts.get(part.same, 0)) for part in way.layout.parts if part.same
    }
    if response.code >= 0:
        told |= {part.name: response.code for part in way.layout.parts if part.role == "code"}
    return way.layout.build(told, data, covered(protocol, asked))


def reported(protocol: Protocol, reply: Reply) -> Assigned:
    """The variables that an answer reports, with their values."""
    if not reply.fields or reply.way is None or reply.way.data is None:
        return ()
    numbers, found = dict(reply.fields), []
    for part in reply.way.data.fields:
        how = part.reports
        if how is None:
            continue
        spec, number = protocol.variables[how.variable], numbers[part.name]
        words = (word for word in spec.words if how.value(word, part.names) == number)
        value: Any = next(words, None)
        rest = 0
        if not spec.words:
            value, rest = divmod(number - how.plus, how.factor) if how.factor else (0, 1)
        if value is not None and spec.holds(value) and not rest:
            found.append((spec.name, value))
    return tuple(found)


def agrees(protocol: Protocol, asked: Judgement, reply: Reply) -> bool:
    """Whether an answer is one that a conforming device may give to a request.

    A device may refuse a valid request by an error that its own state explains, which the grammar
    does not know where answers have errors of their own.
    """
    if reply.reason or reply.response is None:
        return False
    if reply.response is asked.response or not reply.outcomes:
        return True
    if protocol.plain or not asked.valid:
        return not protocol.plain and asked.outcome in reply.outcomes
    return Outcome.VALID not in reply.outcomes or asked.answer_due


def covered(protocol: Protocol, asked: Judgement | None) -> bytes:
    """What the check of a request covers (none: no bytes); see `Layout.covered_in`."""
    return protocol.layout.covered_in(asked.frame) if asked else b""


def usual_way(protocol: Protocol, spec: InstructionSpec | None) -> Way:
    """The way in which a valid frame of an instruction is answered (None: of an unused ID)."""
    data = spec.answer if spec else None
    if data is not None and data.fields:
        return Way(protocol.reply, data)
    return Way(protocol.acknowledgement, data or DataSpec())


def _ways(protocol: Protocol, asked: Judgement | None, held: bytes) -> list[Way]:
    """The ways in which a request can be answered, the likelier first.

    Without a request, `held` tells the instruction if answers repeat its ID.
    """
    spec = asked.instruction if asked else repeated_id(protocol, held)
    errors = [Way(layout, DataSpec()) for layout in protocol.errors]
    if spec is not None:
        return [usual_way(protocol, spec), *errors]
    data = None if protocol.reply.has_data else DataSpec()
    if asked is None:
        return [*errors, Way(protocol.reply, data)]
    return [Way(protocol.acknowledgement, data), *errors]


def repeated_id(protocol: Protocol, held: bytes) -> InstructionSpec | None:
    """The instruction whose ID an answer repeats; None where it repeats none that is known."""
    part = protocol.reply.part("id")
    if part is None or part.same != "id" or part.offset + part.size > len(held):
        return None
    spec = protocol.by_id.get(part.read(held) - part.plus)
    counted = spec.answer.counted if spec and spec.answer else None
    return None if counted and counted.how == "expression" else spec


def _way_of(protocol: Protocol, asked: Judgement, response: ResponseSpec) -> Way:
    """The way in which a response is given: errors in a layout of their own, if there is one."""
    ways = _ways(protocol, asked, b"")
    valid = Outcome.VALID in response.outcomes
    if valid or (ways[0].layout.part("code") is not None and not protocol.errors):
        return ways[0]
    return next((way for way in ways[1:] if way.layout.part("code") is not None), ways[0])


def _size(
    protocol: Protocol, way: Way, held: bytes, asked: Judgement | None, values: Mapping[str, Any]
) -> int | None:
    """As `reply_size`, for one way."""
    layout = way.layout
    if layout.unrepeated(held, values if asked else None):
        return -1
    begun = len(held) >= layout.head
    if asked is None and not layout.has_data and begun and layout.value("length", held):
        return -1  # it has data
    if not layout.has_data or layout.part("length") or way.data is not None:
        return layout.size(held, way.data, values)
    check = layout.check
    if check and (asked or (check.part.size > 1 and not check.asked)):
        # The answer to an unused ID, of which only its check tells where it ends.
        most = min(len(held), protocol.longest_frame)
        least, before = layout.head + layout.tail, covered(protocol, asked)
        size = next(check.right_sizes(held[:most], least, before), None)
        return -1 if size is None and most < len(held) else size
    if asked is None:
        return None if layout.begins(held) else -1
    return layout.size(held, None, values)


def _is_right(protocol: Protocol, way: Way, frame: bytes, asked: Judgement | None) -> bool:
    """Whether a whole answer has right constants, a known code and a right check."""
    code = way.layout.value("code", frame)
    known = code is None or meaning(protocol, code)[1] is not None
    return known and not _damage(protocol, way.layout, frame, asked)


def meaning(protocol: Protocol, code: int | None) -> tuple[tuple[str, ...], ResponseSpec | None]:
    """The names of a code, or of its flags, and the response that tells the outcome."""
    if code is None:
        return (), PLAIN_ANSWER
    codes = codes_in(code, protocol.flags)
    known = [protocol.codes[one] for one in codes if one in protocol.codes]
    if len(known) < len(codes):
        return tuple(one.name for one in known), None
    telling = [one for one in known if one.outcomes] or known
    return tuple(one.name for one in known), telling[0]


def _damage(protocol: Protocol, layout: Layout, frame: bytes, asked: Judgement | None) -> str:
    """What is wrong with a whole answer, in words; its check counts only where that is known."""
    wrong, check = layout.wrong_constant(frame), layout.check
    if wrong or check is None or (asked is None and check.asked):
        return wrong
    return check.wrong(frame, covered(protocol, asked))


def _filled(data: DataSpec, asked: Mapping[str, Any], values: Mapping[str, Any]) -> bytes:
    """The data of an answer: the values that are given, those that the request has, else zeros."""
    built = b""
    for part in data.fields:
        if part.constant is not None:
            built += part.constant
        elif part.name in values:
            built += part.build(values[part.name])
        else:
            repeated = _repeated(data, part, built, asked)
            built += _zeros(data, part, built, asked) if repeated is None else repeated
    return built


def _repeated(
    data: DataSpec, part: FieldSpec, before: bytes, asked: Mapping[str, Any]
) -> bytes | None:
    """The field with the value of the request's field of that name; None where it does not fit."""
    value = asked.get(part.name)
    if value is None or (part.many is None) is not isinstance(value, int):
        return None
    try:
        raw = part.build(value)
    except (ValueError, TypeError, OverflowError):
        return None
    if not part.in_range(part.parse(raw)):
        return None
    counted = part is data.fields[-1] and data.counted and not data.takes_rest
    due = data.measure(before + raw, asked) if counted else None
    return raw if due in (None, len(before + raw)) else None


def _zeros(data: DataSpec, part: FieldSpec, before: bytes, asked: Mapping[str, Any]) -> bytes:
    """The field with zeros, as many as the request asks for, or with the value nearest to 0."""
    many = part.many
    nearest = part.names[0][1] if part.names else min(max(part.low, 0), part.high)
    if many is None:
        return part.build(nearest)
    count = many.fixed
    if many.how == "expression":
        count = ((data.measure(before, asked) or len(before)) - len(before)) // many.width
    return many.build([nearest] * count)
