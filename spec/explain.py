"""Explains bytes: what each group of bits means, what a conforming device answers and does, why."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, repeat

from msgspec.structs import replace

from bilprov.spec.codec import Judgement, judge, nearest, spaced
from bilprov.spec.data import DataSpec, FieldSpec, Many
from bilprov.spec.fields import Outcome
from bilprov.spec.framing import Framer
from bilprov.spec.layout import Layout, Part
from bilprov.spec.protocol import Protocol, ResponseSpec
from bilprov.spec.readings import ERRATA, EXAMPLES, READINGS, Erratum, Example, Reading
from bilprov.spec.replies import Reply, Way, covered, read_reply, reply_size
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
        groups = tuple(_byte_group(frame, at, "data", "no answer") for at in range(len(frame)))
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
    due = judgement.head + judgement.length + protocol.layout.tail
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
    meaning = partial(_part_meaning, protocol, protocol.layout, judgement, None)
    spec = judgement.instruction
    read = judgement.outcome in (Outcome.VALID, Outcome.BAD_DATA)
    data = spec if spec and read else None
    yield from _laid_out(protocol.layout, judgement, data, meaning, _no_fields(judgement))


def _reply_groups(
    protocol: Protocol, reply: Reply, way: Way, asked: Judgement | None
) -> Iterator[BitGroup]:
    """Groups that hold every bit of an answer once, in order."""
    meaning = partial(_part_meaning, protocol, way.layout, reply, asked)
    data = way.data if reply.fields else None
    open_data = "the answer is damaged" if reply.reason else "means nothing"
    if way.data is None and asked is None:
        open_data = "its request is needed to read it"
    yield from _laid_out(way.layout, reply, data, meaning, open_data)


def _laid_out(
    layout: Layout,
    one: Judgement | Reply,
    data: DataSpec | None,
    meaning: Callable[[Part, bytes], tuple[str, bool]],
    no_fields: str,
) -> Iterator[BitGroup]:
    """Groups that hold every bit of a frame or an answer once, in order: its parts, and its data.

    `meaning` gives what a part means, and whether it is wrong; `no_fields` is what data mean that
    are not read as fields (`data` is None).
    """
    frame, whole = one.frame, isinstance(one, Reply) or not one.truncated
    for part in layout.parts:
        if part.offset >= 0 and part.offset + part.size <= len(frame):
            yield from _part_groups(frame, part, part.offset, meaning)
    begun = [p.offset + p.size for p in layout.parts if p.offset + p.size <= len(frame)]
    at = max((end for end in begun if end <= layout.head), default=0)
    if data is not None:
        yield from _data_groups(one, data)
    elif layout.has_data:
        for place in range(at, len(frame) - (layout.tail if whole else 0)):
            yield _byte_group(frame, place, "data", no_fields)
    if whole:
        for part in layout.parts:
            if part.offset < 0:
                yield from _part_groups(frame, part, len(frame) + part.offset, meaning)


def _no_fields(judgement: Judgement) -> str:
    """Why data are not read as fields."""
    if judgement.outcome in (Outcome.BAD_CHECKSUM, Outcome.BAD_SYNC):
        return "the frame is damaged"
    if judgement.framed:
        return "not complete" if judgement.truncated else "means nothing"
    if judgement.truncated:
        return "means nothing while other data are missing"
    return "taken because the header announces it, means nothing"


def _bytes(count: int) -> str:
    return "no data byte" if not count else "1 data byte" if count == 1 else f"{count} data bytes"


def _group(
    raw: bytes, at: int, name: str, value: int, meaning: str, fault: bool = False
) -> BitGroup:
    """The group of whole bytes, of which byte `at` of the frame is the first."""
    return BitGroup(at, len(raw), 8 * len(raw) - 1, 0, _bits(raw), name, value, meaning, fault)


def _byte_group(frame: bytes, at: int, name: str, meaning: str, fault: bool = False) -> BitGroup:
    return _group(frame[at : at + 1], at, name, frame[at], meaning, fault)


def _bits(raw: bytes) -> str:
    return f"{int.from_bytes(raw, 'big'):0{8 * len(raw)}b}"


def _part_groups(
    frame: bytes, part: Part, at: int, meaning: Callable[[Part, bytes], tuple[str, bool]]
) -> Iterator[BitGroup]:
    """The group of a part; of constant bytes each is one."""
    size = part.size
    if part.constant:
        yield from _fixed_bytes(frame, at, part.constant, part)
        return
    raw = frame[at : at + size]
    high = part.shift + part.width - 1 if part.width else 8 * size - 1
    bits = _bits(raw)[8 * size - 1 - high : 8 * size - part.shift]
    value = int(bits, 2) if part.width else part.number.parse(raw)
    yield BitGroup(at, size, high, part.shift, bits, part.name, value, *meaning(part, raw))


def _fixed_bytes(
    frame: bytes, at: int, constant: bytes, part: Part | FieldSpec
) -> Iterator[BitGroup]:
    """A group for each byte of a constant."""
    for place, right in enumerate(constant, at):
        wrong = frame[place] != right
        meaning = f"must be {right:02x}" if wrong else part.prose or "fixed"
        yield _byte_group(frame, place, part.name, meaning, wrong)


def _part_meaning(
    protocol: Protocol,
    layout: Layout,
    one: Judgement | Reply,
    asked: Judgement | None,
    part: Part,
    raw: bytes,
) -> tuple[str, bool]:
    """What a part of a frame, or of an answer to `asked`, means, and whether it is wrong."""
    request = isinstance(one, Judgement)
    if part.role == "constant":
        wrong = part.read(one.frame) != part.low
        return f"must be {part.low}" if wrong else part.prose or "fixed", wrong
    if part.role == "id":
        spec = protocol.by_id.get((part.read(one.frame) - part.plus) & part.most)
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
        return ("right" if raw == right else f"right is {spaced(right)}"), raw != right
    if request and part.role == "address":
        everybody = part.broadcast is not None and one.address == part.broadcast
        wrong = one.address is not None and not part.reaches(one.address)
        told = ", all of them" if everybody else f"; allowed are {part.allowed}" if wrong else ""
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


def _data_groups(judgement: Judgement | Reply, data: DataSpec) -> Iterator[BitGroup]:
    """The groups of the data: a field each, its named bits, or the elements that it has.

    The bytes of a named register are one group.
    """
    head = judgement.head
    named = {head + one.offset: (one, value) for one, value in judgement.registers}
    inside = {at + more for at, (one, _) in named.items() for more in range(one.size)}
    for group in _field_groups(judgement, data):
        if group.byte in named:
            yield _whole_group(judgement, group.byte, *named[group.byte])
        elif group.byte not in inside:
            yield group


def _field_groups(judgement: Judgement | Reply, data: DataSpec) -> Iterator[BitGroup]:
    frame, values = judgement.frame, dict(judgement.fields)
    for spec in data.fields:
        at = judgement.head + spec.offset
        if spec.many:
            yield from _elements(judgement, spec, spec.many, values[spec.name])
        elif spec.constant is not None:
            yield from _fixed_bytes(frame, at, spec.constant, spec)
        elif spec.bits:
            yield from _named_bits(spec, at, frame, values[spec.name])
        else:
            yield _whole_group(judgement, at, spec, values[spec.name])


def _elements(
    judgement: Judgement | Reply, spec: FieldSpec, many: Many, values: Iterable[int]
) -> Iterator[BitGroup]:
    at = judgement.head + spec.offset
    if many.prefix:
        raw = judgement.frame[at : at + many.prefix.size]
        yield _group(raw, at, f"{spec.name} count", many.prefix.parse(raw), many.how)
        at += len(raw)
    for number, value in enumerate(values):
        one = replace(spec, name=f"{spec.name}[{number}]", size=many.width, many=None)
        yield _whole_group(judgement, at, one, value)
        at += many.width


def _named_bits(spec: FieldSpec, at: int, frame: bytes, value: int) -> Iterator[BitGroup]:
    """A group for each bit with a name, and one for those above them."""
    bits, named, width = _bits(frame[at : at + spec.size]), len(spec.bits), 8 * spec.size
    fault = not spec.in_range(value)
    upper = int(bits[: width - named] or "0", 2)
    if width > named:
        must = "must be 0" if spec.high < 1 << named else "without a name"
        wrong = fault and upper > 0
        meaning, above = f"upper bits, {must}", bits[: width - named]
        yield BitGroup(at, spec.size, width - 1, named, above, spec.name, upper, meaning, wrong)
    for place, (name, bit) in enumerate(zip(spec.bits, bits[width - named :], strict=True), 1):
        low, meaning = named - place, "on" if bit == "1" else "off"
        wrong = fault and not upper
        yield BitGroup(at, spec.size, low, low, bit, name, int(bit), meaning, wrong)


def _whole_group(judgement: Judgement | Reply, at: int, spec: FieldSpec, value: int) -> BitGroup:
    """The group of a field that is one number."""
    raw = judgement.frame[at : at + spec.size]
    fault = not spec.in_range(value)
    named = next((name for name, number in spec.names if number == value), "")
    meaning = named or spec.prose
    if fault:
        meaning = "; ".join(filter(None, (meaning, f"allowed are {spec.allowed}")))
    elif not judgement.framed:
        meaning = ", ".join(filter(None, (meaning, spec.allowed)))
    return _group(raw, at, spec.name, value, meaning, fault)


@dataclass(frozen=True, slots=True)
class Finding:
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
