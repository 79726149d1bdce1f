"""Explains bytes: what each group of bits means, what a conforming device answers and does, why."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import chain, repeat
from typing import Any, NamedTuple, TypeAlias

from msgspec.structs import replace

from bilprov.spec.codec import FRAMING_FAULTS, Judgement, data_bytes, judge, nearest, spaced
from bilprov.spec.data import DataSpec, FieldSpec
from bilprov.spec.fields import Outcome
from bilprov.spec.framing import Framer
from bilprov.spec.layout import Layout, Part
from bilprov.spec.protocol import Protocol, ResponseSpec
from bilprov.spec.readings import ERRATA, EXAMPLES, READINGS, Erratum, Example, Reading
from bilprov.spec.replies import Reply, Way, covered, read_reply, reply_size
from bilprov.spec.state import Effect, assigned, value_words


class BitGroup(NamedTuple):
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


class FrameExplanation(NamedTuple):
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


class ResponseExplanation(NamedTuple):
    """One answer of the device, mostly a byte: its bits, and what it means.

    `offset` is the index of its first byte in the explained bytes, `words` is what it is in short.
    `response` is None for an unused code. `reply` is an answer of a layout of its own, else None.
    """

    offset: int
    frame: bytes
    groups: tuple[BitGroup, ...]
    words: str
    response: ResponseSpec | None
    meaning: str
    clause: str
    reply: Reply | None = None


class Explanation(NamedTuple):
    """Explanation of some bytes: `frames` if the host sent them, `responses` if the device did."""

    data: bytes
    frames: tuple[FrameExplanation, ...] = ()
    responses: tuple[ResponseExplanation, ...] = ()


def explain(protocol: Protocol, data: bytes) -> Explanation:
    """Explain bytes that the host sends, cut into frames as the device cuts them.

    An incomplete last frame counts as truncated by the time-out. Raises ValueError for bytes that
    begin no frame.
    """
    findings = check(protocol) if protocol.plain else ()
    frames, offset = [], 0
    for judgement in judged_frames(protocol, data):
        frames.append(_frame(protocol, judgement, offset, data[offset:], findings))
        offset += len(judgement.frame)
    return Explanation(data, frames=tuple(frames))


def judged_frames(protocol: Protocol, data: bytes) -> Iterator[Judgement]:
    """The frames in bytes that the host sends. Raises ValueError for bytes that begin none."""
    cutter = Framer(protocol, None)
    for framed in (*cutter.feed(data, 0), *cutter.drop(0, "truncated")):
        if framed.kind == "garbage":
            sync = protocol.layout.sync
            begin = f"; a frame begins with {spaced(sync)}" if sync else ""
            raise ValueError(f"the bytes {spaced(framed.data)} belong to no frame{begin}")
        yield judge(protocol, framed.data)


def requests_of(protocol: Protocol, asked: bytes) -> tuple[Judgement, ...]:
    """The requests in some bytes, each of which is answered. Raises ValueError if one is not."""
    found = tuple(judged_frames(protocol, asked))
    for one in found:
        if not one.answer_due:
            why = one.reason or "it asks for no answer"
            raise ValueError(f"the request {spaced(one.frame)} is not answered: {why}")
    return found


def explain_responses(
    protocol: Protocol, data: bytes, asked: Sequence[Judgement] = ()
) -> Explanation:
    """Explain the answers that the device sends.

    `asked` are the requests that they answer. Without them, what only these tell is left open.
    """
    responses, offset = [], 0
    for one in chain(asked, repeat(None)):
        held = data[offset:]
        if not held:
            break
        size = reply_size(protocol, held, one) or 0
        frame = held[:size] if 0 < size <= len(held) else held
        responses.append(explain_reply(protocol, frame, one, offset))
        offset += len(frame)
    return Explanation(data, responses=tuple(responses))


def explain_reply(
    protocol: Protocol, frame: bytes, asked: Judgement | None, offset: int = 0
) -> ResponseExplanation:
    """Explain one answer to a request; None if that is not known."""
    reply = read_reply(protocol, frame, asked, alone=asked is None)
    known, words = reply.response, reply.describe()
    meaning = reply.reason or (known.prose if known else "")
    if not (known or reply.reason):
        words, meaning = "unused", "unused: a device that sends one does not conform"
    elif known and known.outcome is not Outcome.VALID and protocol.stops(protocol.on_fault):
        meaning += f"; the {protocol.device} stops ({protocol.clauses.safety})"
    if reply.way:
        groups = tuple(_reply_groups(protocol, reply, reply.way, asked))
    else:
        groups = tuple(_group(frame, at, 1, "data", "no answer") for at in range(len(frame)))
    own = None if protocol.plain else reply
    return ResponseExplanation(
        offset, frame, groups, words, known, meaning, protocol.clauses.responses, own
    )


def _frame(
    protocol: Protocol,
    judgement: Judgement,
    offset: int,
    rest: bytes,
    findings: Iterable[Finding],
) -> FrameExplanation:
    """Explain a frame with which the `rest` of the bytes begins."""
    effect, action = protocol.on_fault, _on_fault(protocol)
    if judgement.valid and judgement.instruction:
        effect, action = judgement.instruction.effect, judgement.instruction.prose
    if judgement.outcome is Outcome.OTHER_ADDRESS:
        effect, action = Effect(), "is not meant, and does nothing"
    size, following = len(judgement.frame), rest[len(judgement.frame) :]
    errata = tuple(
        finding.erratum
        for finding in findings
        if finding.erratum and rest.startswith(finding.sent) and size <= len(finding.sent)
    )
    meant = None
    if protocol.plain and not judgement.valid:
        meant = judge(protocol, nearest(protocol, judgement.frame, following))
    due = judgement.head + judgement.length + protocol.layout.of(judgement.id).tail
    return FrameExplanation(
        offset=offset,
        judgement=judgement,
        groups=tuple(_groups(protocol, judgement)),
        missing=max(0, due - size) if judgement.truncated else 0,
        answer=_answer(protocol, judgement),
        device=protocol.device,
        action=action,
        stops=protocol.stops(effect),
        changes=tuple(
            (name, value_words(new)) for name, new in assigned(effect, dict(judgement.fields))
        ),
        keeps=tuple(name for name in protocol.variables if not effect.sets(name)),
        readings=_readings(judgement, errata) if protocol.plain else (),
        errata=errata,
        nearest=meant,
        differences=tuple(_differences(judgement, meant, following)) if meant else (),
    )


def _on_fault(protocol: Protocol) -> str:
    """What the device does after a faulty instruction, in words."""
    if not protocol.plain:
        return "takes it as a fault"
    does = "changes its state" if protocol.on_fault.assignments else "changes nothing"
    if protocol.stops(protocol.on_fault):
        does = "stops at once"
    return f"{does}, as after any faulty instruction ({protocol.clauses.safety})"


def _answer(protocol: Protocol, judgement: Judgement) -> str:
    """The answer that is due, in words."""
    instruction, response = judgement.instruction, judgement.response
    data = instruction.answer if instruction else None
    names = [part.name for part in data.fields if part.name] if data else []
    holds = f" with {', '.join(names)}" if names and Outcome.VALID in response.outcomes else ""
    if response.code < 0:
        return f"an answer{holds or ' without data'}" if response.outcomes else "none"
    timeout = f"{protocol.timing.truncation_timeout:g} ms"
    waits = f", once {timeout} have passed without a byte" if judgement.truncated else ""
    return f"{response.name}, code {response.code:02x}{holds}{waits if protocol.plain else ''}"


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


def _groups(protocol: Protocol, judgement: Judgement) -> Iterator[BitGroup]:
    """Groups that hold every bit of a frame once, in order."""
    layout = protocol.layout.of(judgement.id)
    meaning = partial(_part_meaning, protocol, layout, judgement, None)
    data = judgement.instruction if judgement.outcome in (Outcome.VALID, Outcome.BAD_DATA) else None
    open_data = "taken because the header announces it, means nothing"
    if judgement.outcome in FRAMING_FAULTS:
        open_data = "the frame is damaged"
    elif judgement.framed:
        open_data = "not complete" if judgement.truncated else "means nothing"
    elif judgement.truncated:
        open_data = "means nothing while other data are missing"
    yield from _laid_out(layout, judgement, data, meaning, open_data)


def _reply_groups(
    protocol: Protocol, reply: Reply, way: Way, asked: Judgement | None
) -> Iterator[BitGroup]:
    """Groups that hold every bit of an answer once, in order."""
    meaning = partial(_part_meaning, protocol, way.layout, reply, asked)
    open_data = "the answer is damaged" if reply.reason else "means nothing"
    if way.data is None and asked is None:
        open_data = "its request is needed to read it"
    data = way.data if reply.fields else None
    yield from _laid_out(way.layout, reply, data, meaning, open_data)


Meaning: TypeAlias = Callable[[Part], tuple[str, bool]]
"""Gives what a part means, and whether it is wrong."""


def _laid_out(
    layout: Layout, one: Judgement | Reply, data: DataSpec | None, meaning: Meaning, open_data: str
) -> Iterator[BitGroup]:
    """Groups that hold every bit of a frame or an answer once, in order: its parts, and its data.

    `open_data` is what data mean that are not read as fields (`data` is None).
    """
    frame, whole = one.frame, isinstance(one, Reply) or not one.truncated
    before, behind, at = list[BitGroup](), list[BitGroup](), 0
    for part in layout.parts:
        end = part.offset + part.size
        if part.offset < 0 and whole:
            behind += _part_groups(frame, part, len(frame) + part.offset, meaning)
        elif part.offset >= 0 and end <= len(frame):
            before += _part_groups(frame, part, part.offset, meaning)
            at = end
    yield from before
    if data is not None:
        yield from _data_groups(one, data)
    elif layout.has_data:
        for place in range(at, len(frame) - (layout.tail if whole else 0)):
            yield _group(frame, place, 1, "data", open_data)
    yield from behind


def _group(
    frame: bytes, at: int, size: int, name: str, meaning: str, fault: bool = False, of: Any = None
) -> BitGroup:
    """The group of some bytes of a frame; `of` is their value, where that is not their bits."""
    found = _bits(frame, at, size, 0, 8 * size, name, meaning, fault)
    return found if of is None else found._replace(value=of)


def _bits(frame: bytes, at: int, size: int, low: int, width: int, *about: Any) -> BitGroup:
    """The group of `width` bits above the lowest `low` of some bytes: its name, meaning, fault."""
    value = int.from_bytes(frame[at : at + size], "big") >> low & (1 << width) - 1
    name, *rest = about
    return BitGroup(at, size, low + width - 1, low, f"{value:0{width}b}", name, value, *rest)


def _part_groups(frame: bytes, part: Part, at: int, meaning: Meaning) -> Iterator[BitGroup]:
    """The group of a part; of constant bytes each is one."""
    if part.constant:
        yield from _fixed_bytes(frame, at, part.constant, part)
    elif part.width:
        yield _bits(frame, at, part.size, part.shift, part.width, part.name, *meaning(part))
    else:
        value = part.number.parse(part.raw(frame))
        yield _group(frame, at, part.size, part.name, *meaning(part), value)


def _fixed_bytes(
    frame: bytes, at: int, constant: bytes, part: Part | FieldSpec
) -> Iterator[BitGroup]:
    """A group for each byte of a constant."""
    for place, right in enumerate(constant, at):
        wrong = frame[place] != right
        meaning = f"must be {right:02x}" if wrong else part.prose or "fixed"
        yield _group(frame, place, 1, part.name, meaning, wrong)


def _part_meaning(
    protocol: Protocol, layout: Layout, one: Judgement | Reply, asked: Judgement | None, part: Part
) -> tuple[str, bool]:
    """What a part of a frame, or of an answer to `asked`, means, and whether it is wrong."""
    request = isinstance(one, Judgement)
    if part.role == "constant":
        wrong = part.read(one.frame) != part.low
        return f"must be {part.low}" if wrong else part.prose or "fixed", wrong
    if part.role == "id":
        spec = protocol.by_id.get(part.repeated(part.read(one.frame)))
        marked = f", marked by {part.plus:02x}: an error" if part.plus else ""
        known = spec.name if spec else "unused: no instruction has it"
        if spec and spec.document != spec.name:
            known += f" ({spec.document})"
        return known + marked, request and spec is None
    if part.role == "length":
        return _announced(one, max(0, part.read(one.frame)))
    if isinstance(one, Reply) and part.role == "code":
        return " ".join(one.names) or "unused", one.response is None
    if part.role == "check" and layout.check:
        if layout.check.asked and asked is None:
            return "counts the request too", False
        right = layout.check.right(one.frame, covered(protocol, asked))
        wrong = part.raw(one.frame) != right
        return f"right is {spaced(right)}" if wrong else "right", wrong
    if request and part.role == "address":
        wrong = one.address is not None and not part.reaches(one.address)
        told = f"; allowed are {part.allowed}" if wrong else ""
        if one.address is not None and one.address == part.broadcast:
            told = ", all of them"
        return f"{part.prose or 'who is meant'}{told}", wrong
    return part.prose or ("who answers" if part.role == "address" else "a number"), False


def _announced(one: Judgement | Reply, count: int) -> tuple[str, bool]:
    """What a length means that announces so many data bytes, and whether it is wrong."""
    meaning = f"{_bytes(count)} announced"
    if isinstance(one, Reply):
        return meaning, False
    spec = one.instruction
    if one.framed or spec is None:
        wrong = one.outcome in (Outcome.TOO_MANY, Outcome.TOO_FEW)
        return meaning, wrong and not one.truncated
    takes = f"; {spec.name} takes {_bytes(spec.length)}"
    return (meaning + takes, True) if count != spec.length else (meaning, False)


def _bytes(count: int) -> str:
    return data_bytes(count) if count else "no data byte"


def _data_groups(one: Judgement | Reply, data: DataSpec) -> Iterator[BitGroup]:
    """The groups of the data: a field each, its named bits, or the elements that it has.

    The bytes of a named register are one group.
    """
    named = {one.head + cell.offset: (cell, value) for cell, value in one.registers}
    inside = {at + more for at, (cell, _) in named.items() for more in range(cell.size)}
    values = dict(one.fields)
    for spec in data.fields:
        for group in _field_groups(one, spec, values.get(spec.name)):
            if group.byte in named:
                yield _whole_group(one, group.byte, *named[group.byte])
            elif group.byte not in inside:
                yield group


def _field_groups(one: Judgement | Reply, spec: FieldSpec, value: Any) -> Iterator[BitGroup]:
    frame, at, many, bits = one.frame, one.head + spec.offset, spec.many, spec.bits
    if spec.constant is not None:
        yield from _fixed_bytes(frame, at, spec.constant, spec)
    elif many:
        if many.prefix:
            size = many.prefix.size
            count = many.prefix.parse(frame[at : at + size])
            yield _group(frame, at, size, f"{spec.name} count", many.how, of=count)
            at += size
        for number, element in enumerate(value):
            cell = replace(spec, name=f"{spec.name}[{number}]", size=many.width, many=None)
            yield _whole_group(one, at, cell, element)
            at += many.width
    elif bits:
        named, width, fault = len(bits), 8 * spec.size, not spec.in_range(value)
        whole = int.from_bytes(frame[at : at + spec.size], "big")
        if width > named:
            must = "must be 0" if spec.high < 1 << named else "without a name"
            about = spec.name, f"upper bits, {must}", fault and whole >> named > 0
            yield _bits(frame, at, spec.size, named, width - named, *about)
        for low, name in zip(reversed(range(named)), bits, strict=True):
            wrong, meaning = fault and not whole >> named, "on" if whole >> low & 1 else "off"
            yield _bits(frame, at, spec.size, low, 1, name, meaning, wrong)
    else:
        yield _whole_group(one, at, spec, value)


def _whole_group(one: Judgement | Reply, at: int, spec: FieldSpec, value: int) -> BitGroup:
    """The group of a field that is one number."""
    fault, named = not spec.in_range(value), spec.named(value)
    meaning = spec.prose if named == value else named
    if fault:
        meaning = "; ".join(filter(None, (meaning, f"allowed are {spec.allowed}")))
    elif not one.framed:
        meaning = ", ".join(filter(None, (meaning, spec.allowed)))
    return _group(one.frame, at, spec.size, spec.name, meaning, fault, value)


class Finding(NamedTuple):
    """An example line that a conforming device refuses.

    `sent` is the line's bytes, `meant` the nearest valid frame, `erratum` the entry that records
    the contradiction (None if no entry does yet).
    """

    example: Example
    sent: bytes
    reason: str
    meant: bytes
    erratum: Erratum | None


def check(protocol: Protocol, examples: tuple[Example, ...] = EXAMPLES) -> tuple[Finding, ...]:
    """Return every example line that the grammar finds faulty. One line is one instruction."""
    findings = []
    for example in examples:
        sent = bytes(int(bits, 2) for bits in example.bits.split())
        first, *others = judged_frames(protocol, sent)
        if first.valid and not others:
            continue
        extra = len(sent) - len(first.frame)
        reason = first.reason
        if extra:
            more = "1 byte more" if extra == 1 else f"{extra} bytes more"
            reason = f"{reason or first.describe()}; {more} in the line, read as a new header"
        known = next((e for e in ERRATA if e.example == (example.section, example.line)), None)
        meant = nearest(protocol, first.frame, sent[len(first.frame) :])
        findings.append(Finding(example, sent, reason, meant, known))
    return tuple(findings)
