"""Explains bytes: what each group of bits means, what a conforming device answers and does, why."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from bilprov.spec.codec import Judgement, judge, nearest, spaced
from bilprov.spec.data import FieldSpec
from bilprov.spec.errata import Finding, check
from bilprov.spec.fields import Outcome
from bilprov.spec.framing import Framer, framer
from bilprov.spec.layout import Layout, Part
from bilprov.spec.protocol import InstructionSpec, Protocol, ResponseSpec
from bilprov.spec.readings import READINGS, Erratum, Reading
from bilprov.spec.state import Effect, assigned, value_words


@dataclass(frozen=True, slots=True)
class BitGroup:
    """Neighbouring bits that have one meaning.

    `byte` is the index in the frame of the first byte they lie in, `size` how many bytes that is.
    `high` and `low` are bit positions, counted from 0 at the right end of those bytes. `fault`
    marks the bits that make the frame faulty.
    """

    byte: int
    size: int
    high: int
    low: int
    bits: str
    name: str
    value: int
    meaning: str
    fault: bool = False


@dataclass(frozen=True, slots=True)
class FrameExplanation:
    """One frame of the host: its bits, its judgement, and what a conforming device does.

    `offset` is the index of its first byte in the explained bytes, `missing` the number of data
    bytes that did not come. `answer` and `action` are sentences, the latter about the `device`;
    `changes` pairs each state variable that is set with its new value in words, `keeps` names the
    others. `nearest` is the judgement of the nearest valid frame (None if this one is valid),
    `differences` how that differs from this frame.
    """

    offset: int
    judgement: Judgement
    groups: tuple[BitGroup, ...]
    missing: int
    answer: str
    device: str
    action: str
    stops: bool
    changes: tuple[tuple[str, str], ...]
    keeps: tuple[str, ...]
    readings: tuple[Reading, ...]
    errata: tuple[Erratum, ...]
    nearest: Judgement | None
    differences: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ResponseExplanation:
    """One byte of the device; `response` is None for an unused code."""

    offset: int
    byte: int
    group: BitGroup
    response: ResponseSpec | None
    meaning: str
    clause: str


@dataclass(frozen=True, slots=True)
class Explanation:
    """Explanation of some bytes: `frames` if the host sent them, `responses` if the device did."""

    data: bytes
    frames: tuple[FrameExplanation, ...] = ()
    responses: tuple[ResponseExplanation, ...] = ()


def explain(protocol: Protocol, data: bytes) -> Explanation:
    """Explain bytes that the host sends, cut into frames as the device cuts them.

    An incomplete last frame counts as truncated by the time-out. Raises ValueError for bytes that
    begin no frame.
    """
    if not protocol.plain:
        return Explanation(data, frames=tuple(_framed(protocol, data)))
    cutter = Framer(protocol.lengths, timeout=None)
    findings = check(protocol)
    frames, offset = [], 0
    for framed in (*cutter.feed(data, 0), *cutter.drop(0, "truncated")):
        frames.append(_frame(protocol, data, offset, framed.data, findings))
        offset += len(framed.data)
    return Explanation(data, frames=tuple(frames))


def explain_responses(protocol: Protocol, data: bytes) -> Explanation:
    """Explain bytes that the device sends: one response each.

    Raises ValueError where answers are more than one byte: what they hold follows from the request.
    """
    if not protocol.plain:
        raise ValueError(
            f"what an answer of {protocol.name} holds follows from its request; decode a capture "
            "or JSON lines of both, with decode or spec check"
        )
    responses = tuple(_response(protocol, offset, byte) for offset, byte in enumerate(data))
    return Explanation(data, responses=responses)


def _response(protocol: Protocol, offset: int, byte: int) -> ResponseExplanation:
    response = protocol.codes.get(byte)
    if response is None:
        meaning = "unused: a device that sends one does not conform"
    else:
        meaning = response.prose
        if response.outcome is not Outcome.VALID and protocol.stops(protocol.on_fault):
            meaning += f"; the {protocol.device} stops ({protocol.clauses.safety})"
    name = response.name if response else "unused"
    group = BitGroup(0, 1, 7, 0, f"{byte:08b}", "code", byte, name, fault=response is None)
    return ResponseExplanation(offset, byte, group, response, meaning, protocol.clauses.responses)


def _frame(
    protocol: Protocol, data: bytes, offset: int, frame: bytes, findings: Iterable[Finding]
) -> FrameExplanation:
    judgement = judge(protocol, frame)
    rest = data[offset:]
    effect, instruction = protocol.on_fault, judgement.instruction
    does = "stops at once" if protocol.stops(effect) else "changes nothing"
    if effect.assignments and not protocol.stops(effect):
        does = "changes its state"
    action = f"{does}, as after any faulty instruction ({protocol.clauses.safety})"
    if judgement.valid and instruction:
        effect, action = instruction.effect, instruction.prose
    answer = f"{judgement.response.name}, code {judgement.response.code:02x}"
    if judgement.truncated:
        answer += f", once {protocol.timing.truncation_timeout:g} ms have passed without a byte"
    errata = tuple(
        finding.erratum
        for finding in findings
        if finding.erratum and rest.startswith(finding.sent) and len(frame) <= len(finding.sent)
    )
    meant = (
        None if judgement.valid else judge(protocol, nearest(protocol, frame, rest[len(frame) :]))
    )
    return FrameExplanation(
        offset=offset,
        judgement=judgement,
        groups=bit_groups(protocol, judgement),
        missing=1 + judgement.length - len(frame),
        answer=answer,
        device=protocol.device,
        action=action,
        stops=protocol.stops(effect),
        changes=tuple(_changes(effect, dict(judgement.fields))),
        keeps=tuple(name for name in protocol.variables if not effect.sets(name)),
        readings=_readings(judgement, errata),
        errata=errata,
        nearest=meant,
        differences=tuple(_differences(judgement, meant, rest[len(frame) :])) if meant else (),
    )


def _changes(effect: Effect, fields: dict[str, int]) -> Iterator[tuple[str, str]]:
    for variable, value in assigned(effect, fields):
        yield variable, value_words(value)


def _readings(judgement: Judgement, errata: Iterable[Erratum]) -> tuple[Reading, ...]:
    """Return the readings that the judgement rests on, in the order of the document."""
    ids = {judgement.reading}
    if judgement.truncated:
        ids.add("R-truncation-timeout")
    elif judgement.outcome is Outcome.UNKNOWN_ID and judgement.length:
        ids.add("R-drain-unused")
    elif judgement.outcome in (Outcome.TOO_MANY, Outcome.TOO_FEW) and judgement.length:
        ids.add("R-drain-known")
    places = {erratum.clause for erratum in errata}
    return tuple(r for r in READINGS if r.id in ids or r.clause in places)


def _differences(judgement: Judgement, meant: Judgement, following: bytes) -> Iterator[str]:
    """Yield how the nearest valid frame differs, part by part, each in words."""
    if meant.id != judgement.id:
        yield f"id {judgement.id} becomes {meant.id}"
    if meant.length != judgement.length:
        yield f"length {judgement.length} becomes {meant.length}"
    came, right = judgement.frame[1:], meant.frame[1:]
    for index, (old, new) in enumerate(zip(came, right, strict=False), 1):
        if old != new:
            yield f"byte {index} {old:02x} becomes {new:02x}"
    if len(came) > len(right):
        yield f"{spaced(came[len(right) :])} is left out"
    elif len(right) > len(came):
        added = right[len(came) :]
        where = "what follows" if following.startswith(added) else "added"
        yield f"{spaced(added)} is {'taken from ' if where != 'added' else ''}{where}"


def bit_groups(protocol: Protocol, judgement: Judgement) -> tuple[BitGroup, ...]:
    """Return groups that hold every bit of the frame exactly once, in order."""
    return *_header_groups(protocol, judgement), *_data_groups(judgement)


def _header_groups(protocol: Protocol, judgement: Judgement) -> Iterator[BitGroup]:
    instruction = judgement.instruction
    bits, at = f"{judgement.frame[0]:08b}", 0
    for name, width, _ in protocol.header_bits:
        if name == "id":
            value, fault = judgement.id, instruction is None
            meaning = _instruction(instruction) if instruction else "unused: no instruction has it"
        else:
            value, meaning = judgement.length, f"{_bytes(judgement.length)} announced"
            fault = instruction is not None and instruction.length != value
            if instruction and fault:
                meaning += f"; {instruction.name} takes {_bytes(instruction.length)}"
        yield BitGroup(
            0, 1, 7 - at, 8 - at - width, bits[at : at + width], name, value, meaning, fault
        )
        at += width


def _instruction(spec: InstructionSpec) -> str:
    return spec.name if spec.document == spec.name else f"{spec.name} ({spec.document})"


def _bytes(count: int) -> str:
    return "no data byte" if not count else "1 data byte" if count == 1 else f"{count} data bytes"


def _data_groups(judgement: Judgement) -> Iterator[BitGroup]:
    if judgement.instruction and judgement.fields:
        for spec, (_, value) in zip(judgement.instruction.fields, judgement.fields, strict=True):
            yield from _field_groups(spec, value, judgement.frame)
        return
    meaning = "taken because the header announces it, means nothing"
    if judgement.truncated:
        meaning = "means nothing while other data are missing"
    for index, byte in enumerate(judgement.frame[1:], 1):
        yield BitGroup(index, 1, 7, 0, f"{byte:08b}", "data", byte, meaning)


def _field_groups(spec: FieldSpec, value: int, frame: bytes) -> Iterator[BitGroup]:
    byte, width = 1 + spec.offset, 8 * spec.size
    raw = int.from_bytes(frame[byte : byte + spec.size], "big")
    bits = f"{raw:0{width}b}"
    fault = not spec.low <= value <= spec.high
    if not spec.bits:
        limits = f"{'; allowed are' if fault else ','} {spec.low} to {spec.high}"
        meaning = f"{spec.prose or spec.name}{limits}"
        yield BitGroup(byte, spec.size, width - 1, 0, bits, spec.name, value, meaning, fault)
        return
    named = len(spec.bits)
    upper = raw >> named
    if width > named:
        meaning = "must be 0" if spec.high < 1 << named else "without a name"
        yield BitGroup(
            byte,
            spec.size,
            width - 1,
            named,
            bits[: width - named],
            spec.name,
            upper,
            f"upper bits, {meaning}",
            fault and upper > 0,
        )
    for place, name in enumerate(spec.bits):
        at = named - 1 - place
        value = raw >> at & 1
        meaning = "on" if value else "off"
        yield BitGroup(
            byte, spec.size, at, at, str(value), name, value, meaning, fault and not upper
        )


def _framed(protocol: Protocol, data: bytes) -> Iterator[FrameExplanation]:
    """Explain frames that have a layout of their own. Raises ValueError for bytes of no frame."""
    cutter, offset = framer(protocol, None), 0
    for framed in (*cutter.feed(data, 0), *cutter.drop(0, "truncated")):
        if framed.kind == "garbage":
            sync = protocol.layout.sync
            begin = f"; a frame begins with {spaced(sync)}" if sync else ""
            raise ValueError(f"the bytes {spaced(framed.data)} belong to no frame{begin}")
        yield _layout_frame(protocol, judge(protocol, framed.data), offset)
        offset += len(framed.data)


def _layout_frame(protocol: Protocol, judgement: Judgement, offset: int) -> FrameExplanation:
    instruction = judgement.instruction
    valid = judgement.valid and instruction is not None
    effect = instruction.effect if valid and instruction else protocol.on_fault
    action = instruction.prose if valid and instruction else "takes it as a fault"
    due = judgement.head + judgement.length + protocol.layout.tail
    return FrameExplanation(
        offset=offset,
        judgement=judgement,
        groups=tuple(_layout_groups(protocol, judgement)),
        missing=max(0, due - len(judgement.frame)) if judgement.truncated else 0,
        answer=_answer(instruction, judgement.response),
        device=protocol.device,
        action=action,
        stops=protocol.stops(effect),
        changes=tuple(_changes(effect, dict(judgement.fields))),
        keeps=tuple(name for name in protocol.variables if not effect.sets(name)),
        readings=(),
        errata=(),
        nearest=None,
        differences=(),
    )


def _answer(instruction: InstructionSpec | None, response: ResponseSpec) -> str:
    """The answer that is due, in words."""
    data = instruction.answer if instruction else None
    names = [part.name for part in data.fields if part.name] if data else []
    holds = f" with {', '.join(names)}" if names and Outcome.VALID in response.outcomes else ""
    if response.code >= 0:
        return f"{response.name}, code {response.code:02x}{holds}"
    return f"an answer{holds or ' without data'}" if response.outcomes else "none"


def _layout_groups(protocol: Protocol, judgement: Judgement) -> Iterator[BitGroup]:
    """Groups that hold every bit of the frame once, in order: its parts, and its data."""
    frame, layout = judgement.frame, protocol.layout
    whole = not judgement.truncated
    for part in layout.parts:
        if part.offset >= 0 and part.offset + part.size <= len(frame):
            yield from _part_groups(layout, judgement, part, part.offset)
    begun = [p.offset + p.size for p in layout.parts if p.offset + p.size <= len(frame)]
    at = max((end for end in begun if end <= layout.head), default=0)
    end = len(frame) - (layout.tail if whole else 0)
    if judgement.instruction and judgement.fields:
        yield from _framed_fields(judgement, layout.head)
    else:
        for place in range(at, end):
            yield _byte_group(frame, place, "data", "not complete" if not whole else "")
    if whole:
        for part in layout.parts:
            if part.offset < 0:
                yield from _part_groups(layout, judgement, part, len(frame) + part.offset)


def _byte_group(frame: bytes, at: int, name: str, meaning: str) -> BitGroup:
    return BitGroup(at, 1, 7, 0, f"{frame[at]:08b}", name, frame[at], meaning or "means nothing")


def _part_groups(layout: Layout, judgement: Judgement, part: Part, at: int) -> Iterator[BitGroup]:
    """The group of a part; of constant bytes each is one."""
    frame, size = judgement.frame, part.size
    if part.role == "constant":
        for place, right in enumerate(part.constant, at):
            wrong = frame[place] != right
            meaning = f"must be {right:02x}" if wrong else part.prose or "fixed"
            yield replace(_byte_group(frame, place, part.name, meaning), fault=wrong)
        return
    raw = frame[at : at + size]
    high = part.shift + part.width - 1 if part.width else 8 * size - 1
    bits = f"{int.from_bytes(raw, 'big'):0{8 * size}b}"[8 * size - 1 - high : 8 * size - part.shift]
    meaning, fault = _part_meaning(layout, judgement, part, raw)
    value = int(bits, 2) if part.width else part.number.parse(raw)
    yield BitGroup(at, size, high, part.shift, bits, part.name, value, meaning, fault)


def _part_meaning(layout: Layout, judgement: Judgement, part: Part, raw: bytes) -> tuple[str, bool]:
    """What a part means in a frame, and whether it is wrong."""
    if part.role == "id":
        spec = judgement.instruction
        return (_instruction(spec) if spec else "unused: no instruction has it"), spec is None
    if part.role == "length":
        announced = max(0, part.read(judgement.frame))
        wrong = judgement.outcome in (Outcome.TOO_MANY, Outcome.TOO_FEW)
        return f"{_bytes(announced)} announced", wrong and not judgement.truncated
    if part.role == "check" and layout.check:
        right = part.number.build(layout.check.due(judgement.frame))
        return ("right" if raw == right else f"right is {spaced(right)}"), raw != right
    if part.role == "address":
        everybody = part.broadcast is not None and judgement.address == part.broadcast
        return f"{part.prose or 'who is meant'}{', all of them' if everybody else ''}", False
    return part.prose or "a number", False


def _framed_fields(judgement: Judgement, head: int) -> Iterator[BitGroup]:
    """The groups of the data: a field each, or an element of one that has several."""
    assert judgement.instruction is not None
    frame = judgement.frame
    values = dict(judgement.fields)
    wrong = judgement.instruction.data.wrong(frame[head:])
    for spec in judgement.instruction.fields:
        at = head + spec.offset
        if spec.many is None:
            yield _whole_group(frame, at, spec, values.get(spec.name, 0), spec is wrong)
            continue
        if spec.many.prefix:
            count = spec.many.prefix
            value = count.parse(frame[at : at + count.size])
            bits = f"{int.from_bytes(frame[at : at + count.size], 'big'):0{8 * count.size}b}"
            yield BitGroup(
                at,
                count.size,
                8 * count.size - 1,
                0,
                bits,
                f"{spec.name} count",
                value,
                spec.many.how,
            )
            at += count.size
        width, value = spec.many.width, values[spec.name]
        for number, one in enumerate(value):
            raw = frame[at : at + width]
            bits = f"{int.from_bytes(raw, 'big'):0{8 * width}b}"
            name = f"{spec.name}[{number}]"
            yield BitGroup(at, width, 8 * width - 1, 0, bits, name, one, spec.prose or spec.name)
            at += width


def _whole_group(frame: bytes, at: int, spec: FieldSpec, value: int, wrong: bool) -> BitGroup:
    """The group of a field that is one number, or constant bytes."""
    raw = frame[at : at + spec.size]
    bits = f"{int.from_bytes(raw, 'big'):0{8 * spec.size}b}"
    named = next((name for name, number in spec.names if number == value), "")
    meaning = named or spec.prose or spec.name
    if spec.constant is not None:
        value = int.from_bytes(raw, "big")
    if wrong:
        meaning += f"; allowed are {spec.allowed}"
    return BitGroup(at, spec.size, 8 * spec.size - 1, 0, bits, spec.name, value, meaning, wrong)
