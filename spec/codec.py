"""Builds frames (valid and raw ones), judges a frame, and finds the nearest valid frame.

A judgement says which response a conforming device gives to the bytes, and why. It is the kit's own
reading of the document and does not depend on what any device answered.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeAlias

import msgspec
from msgspec.structs import replace

from bilprov.spec.data import DataSpec, FieldSpec, Value, shown_value
from bilprov.spec.fields import Memory, Outcome
from bilprov.spec.layout import Part
from bilprov.spec.protocol import (
    NO_ANSWER,
    PLAIN_ANSWER,
    InstructionSpec,
    Protocol,
    ResponseSpec,
    cells_in,
)
from bilprov.spec.state import Assigned, assigned

Registers: TypeAlias = tuple[tuple[FieldSpec, int], ...]
"""Named registers with their values, each as a field at its place in some data."""


class Judgement(msgspec.Struct, frozen=True, gc=False):
    """The judgement of one frame: the response of a conforming device, and the reason.

    `frame` is the bytes as they came, `length` the number of data bytes that it announces or must
    have, `instruction` is None for an unused ID, `fields` are the decoded data (empty unless the
    lengths are right). `valid` is true only for a complete frame without fault, `truncated` says
    that it is not complete. `clause` and `reading` are what the reason rests on. `address` is who
    is meant, None where frames have no address; `head` bytes come before the data. `key` is that
    of `Protocol.keys`, and `framed` says that a frame is more than a header byte and data.
    `response` is NO_ANSWER where none is due. `registers` are the named registers that it writes,
    each as a field in its place of the data, with its value.
    """

    frame: bytes
    id: int
    length: int
    instruction: InstructionSpec | None
    fields: tuple[tuple[str, Any], ...]
    outcome: Outcome
    response: ResponseSpec
    reason: str
    clause: str
    reading: str = ""
    truncated: bool = False
    address: int | None = None
    head: int = 1
    key: int = 0
    framed: bool = False
    registers: Registers = ()

    @property
    def values(self) -> tuple[tuple[str, Any], ...]:
        """The values of its fields and of its registers, by name."""
        named = ((one.name, value) for one, value in self.registers)
        return (*self.fields, *named) if self.registers else self.fields

    @property
    def valid(self) -> bool:
        """Whether the frame is without fault."""
        return self.outcome is Outcome.VALID

    @property
    def answer_due(self) -> bool:
        """Whether a conforming device answers."""
        return self.response is not NO_ANSWER

    @property
    def expected(self) -> str:
        """The name of the response that is due; `valid` where a valid frame's has no code."""
        return self.response.name if self.response is not PLAIN_ANSWER else self.outcome.value

    @property
    def name(self) -> str:
        """The instruction's name, or `unused` and the ID."""
        if self.id < 0:
            return "incomplete frame"
        return self.instruction.name if self.instruction else f"unused {self.id}"

    def describe(self) -> str:
        """Return the frame in words: `LED rgb=5 (R B)`, `Stop`, `unused 9, 2 data bytes`."""
        to = f"@{self.address} " if self.address is not None else ""
        more = f", {data_bytes(self.length)}"
        if self.outcome in (*FRAMING_FAULTS, Outcome.OTHER_ADDRESS):
            more = f", {self.outcome.value}"
        elif self.instruction and self.fields:
            specs = {spec.name: spec for spec in self.instruction.fields}
            shown = [field_words(specs[name], value) for name, value in self.fields]
            shown += [field_words(spec, value) for spec, value in self.registers]
            more = f" {' '.join(shown)}"
        elif (self.instruction and self.valid) or self.id < 0:
            more = ""
        elif self.truncated:
            more = f", {max(0, len(self.frame) - self.head)} of {data_bytes(self.length)}"
        return f"{to}{self.name}{more}"


_BY_DATA = (Outcome.VALID, Outcome.BAD_DATA)

FRAMING_FAULTS = (Outcome.BAD_CHECKSUM, Outcome.BAD_SYNC)
"""The outcomes of frames whose parts around the data are wrong."""


def spaced(data: bytes) -> str:
    """Return bytes in hex as the kit shows them everywhere: `81 05`."""
    return data.hex(" ")


def data_bytes(count: int, what: str = "data byte") -> str:
    """A number of data bytes in words, or of something else."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def field_words(spec: FieldSpec, value: Value) -> str:
    """A field and its value in words: `rgb=5 (R B)`."""
    if not spec.bits or not isinstance(value, int) or value > spec.high:
        return f"{spec.name}={shown_value(spec, value)}"
    top = len(spec.bits) - 1
    names = [name for place, name in enumerate(spec.bits) if value >> (top - place) & 1]
    return f"{spec.name}={value} ({' '.join(names) or 'off'})"


def judge(protocol: Protocol, frame: bytes) -> Judgement:
    """Judge one frame, whole or cut short (truncated).

    What stands around the data is judged first, as a device reads it: constants, the check, then
    whom it is for; then the ID, the length and the data (R-unused-length, R-competing-errors).
    Raises ValueError for no bytes, or for more than the one header byte of a car announces.
    """
    if not frame:
        raise ValueError("an empty frame cannot be judged; it needs at least a header byte")
    layout = protocol.layout
    begun = len(frame) >= layout.head
    identity, address, size = _head(protocol, frame) if begun else (None, None, 0)
    spec = protocol.by_id.get(identity) if identity is not None else None
    layout = layout.of(identity)
    if protocol.plain and len(frame) > size:
        raise ValueError(
            f"frame {spaced(frame)} has {data_bytes(len(frame) - 1)}, its header says {size - 1}"
        )
    whole = begun and max(size, layout.head + layout.tail) <= len(frame)
    data = layout.data_of(frame) if whole else frame[layout.head :]
    told = size > 0 and (spec or layout.part("length"))
    length = max(0, size - layout.head - layout.tail) if told else len(data)
    judged = _fault if whole else _cut_short
    outcome, reason = judged(protocol, frame, spec, data, length)
    fields: tuple[tuple[str, Any], ...] = ()
    registers: Registers = ()
    wrong, code, reading = None, "", ""
    if spec and outcome in _BY_DATA:
        fields = tuple(spec.decode(data).items())
        registers = registers_in(protocol, spec.writes, spec, data, dict(fields))
        wrong = spec.wrong(data) if outcome is Outcome.BAD_DATA else None
    if wrong:
        code, reading = wrong.code, wrong.reading
    elif protocol.plain:
        reading = _reading(spec, length, valid=outcome is Outcome.VALID, whole=whole)
    heard = whole or layout.check is None  # what is cut short has no right check
    about_data = outcome in (*_BY_DATA, Outcome.UNKNOWN_ID)
    return Judgement(
        frame=frame,
        id=identity if identity is not None else -1,
        length=length,
        instruction=spec,
        fields=fields,
        outcome=outcome,
        response=_response(protocol, outcome, spec, address, code) if heard else NO_ANSWER,
        reason=reason,
        clause=protocol.clauses.instructions if about_data else protocol.clauses.responses,
        reading=reading,
        truncated=not whole,
        address=address,
        head=layout.head,
        key=protocol.key_of(identity),
        framed=not protocol.plain,
        registers=registers,
    )


def _head(protocol: Protocol, frame: bytes) -> tuple[int | None, int | None, int]:
    """The ID and the address that a frame begins with, and its size (bytes; 0: not known)."""
    if protocol.plain:  # by a table: most of the frames that are judged one by one are a car's
        identity, length = protocol.headers[frame[0]]
        return identity, None, 1 + length
    layout = protocol.layout
    known = layout.value("id", frame)
    spec = protocol.by_id.get(known) if known is not None else None
    return known, layout.value("address", frame), layout.size(frame, spec) or 0


def _reading(spec: InstructionSpec | None, length: int, *, valid: bool, whole: bool) -> str:
    """The reading of the car's document on which a judgement about ID and length rests."""
    if spec is None:
        unused = "R-unused-length" if length else ""
        return unused if whole else "R-truncated-unused"
    if not whole:
        return "R-truncated-long" if length > spec.length else "R-truncated-known"
    return "" if valid else "R-known-length"


def registers_in(
    protocol: Protocol,
    memory: Memory | None,
    spec: DataSpec,
    data: bytes,
    asked: Mapping[str, Any],
) -> Registers:
    """The named registers whose cells are in some data, which `spec` lays out.

    `memory` is what the data write or read, None for nothing; `asked` has the fields of the request
    by name, which tell the first cell.
    """
    if not protocol.registers or memory is None or memory.bits or memory.keep or memory.latest:
        return ()
    part, width = cells_in(memory, spec)
    many = part.many
    begin = part.offset + (many.prefix.size if many and many.prefix else 0)
    end = len(data) if many and many.how != "fixed" else part.offset + part.size
    first = memory.cell(asked[memory.at]) if memory.at else 0
    spans = [("", begin, end)]
    if memory.blocks:
        size = asked[memory.count] * width
        starts = range(begin + 1, end - size + 1, 1 + size)
        spans = [(f"@{data[at - 1]}", at, at + size) for at in starts]
    return tuple(
        (replace(one, name=one.name + whose, offset=at), one.parse(data[at : at + one.size]))
        for whose, start, stop in spans
        for place, one in protocol.registers.get(memory.name, {}).items()
        if start <= (at := start + (place - first) * width) <= stop - one.size
    )


def _cut_short(
    protocol: Protocol, frame: bytes, spec: InstructionSpec | None, data: bytes, length: int
) -> tuple[Outcome, str]:
    """The fault of a frame that is not complete, and why it is one."""
    layout, name = protocol.layout.of_frame(frame), f"{spec.name}: " if spec else ""
    begun = len(frame) >= layout.head
    if spec is None and begun and not layout.check:
        return Outcome.UNKNOWN_ID, _unused(protocol, frame)
    if layout.part("length") and not layout.tail and begun:
        return Outcome.TOO_FEW, f"{name}{data_bytes(length)} announced, {len(data)} came"
    size = layout.head + length + layout.tail
    of = f" of {data_bytes(size, 'byte')}" if spec and size > len(frame) else ""
    return Outcome.TOO_FEW, f"{name}{data_bytes(len(frame), 'byte')}{of} came"


def _unused(protocol: Protocol, frame: bytes) -> str:
    used = ", ".join(map(str, protocol.by_id))
    return f"no instruction has ID {protocol.layout.value('id', frame)}, used are {used}"


def _fault(
    protocol: Protocol, frame: bytes, spec: InstructionSpec | None, data: bytes, length: int
) -> tuple[Outcome, str]:
    """The outcome of a whole frame, and why."""
    layout = protocol.layout.of_frame(frame)
    wrong = layout.wrong_constant(frame)
    if wrong:
        return Outcome.BAD_SYNC, wrong
    wrong = layout.check.wrong(frame) if layout.check else ""
    if wrong:
        return Outcome.BAD_CHECKSUM, wrong
    to = layout.part("address")
    if to and not to.reaches(to.read(frame)):
        reason = f"{to.name} is {to.read(frame)}, allowed are {to.allowed}: it is for no device"
        return Outcome.OTHER_ADDRESS, reason
    if spec is None:
        return Outcome.UNKNOWN_ID, _unused(protocol, frame)
    needed = spec.measure(data)
    came = f"the header says {length}" if protocol.plain else f"{len(data)} came"
    if needed is None or len(data) < needed:
        return Outcome.TOO_FEW, f"{spec.name} takes {data_bytes(needed or spec.length)}, {came}"
    if len(data) > needed and not spec.takes_rest:
        return Outcome.TOO_MANY, f"{spec.name} takes {data_bytes(needed)}, {came}"
    part = spec.wrong(data)
    if part is None:
        return Outcome.VALID, ""
    value = shown_value(part, part.parse(spec.raw(part, data)))
    at = f" (frame {spaced(frame)}, byte {1 + part.offset})" if protocol.plain else ""
    name = f"{spec.name}.{part.name or 'constant'}"
    return Outcome.BAD_DATA, f"{name} is {value}, allowed are {part.allowed}{at}"


def _response(
    protocol: Protocol,
    outcome: Outcome,
    spec: InstructionSpec | None,
    address: int | None,
    code: str,
) -> ResponseSpec:
    """The response that is due; NO_ANSWER for what is sent to all or to nobody."""
    part = protocol.layout.part("address")
    if part and address is not None and not part.low <= address <= part.high:
        return NO_ANSWER  # sent to all, or to nobody
    if spec and outcome is Outcome.VALID:
        if spec.answer is None:
            return NO_ANSWER
        if protocol.key_of(spec.id) in protocol.uncoded:
            return PLAIN_ANSWER
    named = next((one for one in protocol.responses if code and one.name == code), None)
    return named or protocol.answers[outcome]


def build(protocol: Protocol, name: str, fields: Mapping[str, Any] | None = None) -> bytes:
    """Build a valid frame. `name` is an instruction in any case, `fields` its values by name.

    Where frames have an address or other parts besides, `fields` has them too. Named registers may
    be given instead of the fields that write them, and a register's name as the place from which
    one is read. Raises ValueError, in one sentence, for an unknown instruction, a missing or
    unknown field, or a value out of its range.
    """
    given = dict(fields or {})
    spec = next((s for s in protocol.instructions if s.name.lower() == name.lower()), None)
    if spec is None:
        raise ValueError(
            f"there is no instruction {name!r}; there are "
            f"{', '.join(s.name for s in protocol.instructions)}"
        )
    given = _by_register(protocol, spec, given)
    data = b"".join(
        part.constant if part.constant is not None else _built(spec.name, part, given)
        for part in spec.fields
    )
    counted, needed = spec.counted, spec.measure(data)
    if counted and counted.how == "expression" and needed != len(data):
        raise ValueError(
            f"{spec.name}.{spec.fields[-1].name} makes {data_bytes(len(data))}, the fields before "
            f"it ask for {data_bytes(needed or 0)}"
        )
    _require_counted(spec, data)
    parts = {part.name: _built_part(spec.name, part, given) for part in free_parts(protocol)}
    if given:
        takes = (
            ", ".join([*parts, *(part.name for part in spec.fields if part.name)]) or "no fields"
        )
        raise ValueError(f"{spec.name} has no field {', '.join(given)}; it takes {takes}")
    length = protocol.layout.part("length")
    if length and len(data) > length.most:
        raise ValueError(
            f"{spec.name} has {data_bytes(len(data))}; a header announces at most {length.most}"
        )
    return protocol.layout.build({**parts, "id": spec.id}, data)


def _require_counted(spec: InstructionSpec, data: bytes) -> None:
    """Raise ValueError where a request counts other cells than those that it writes."""
    memory, values = spec.writes, spec.decode(data)
    if memory is None or memory.blocks or memory.count not in values:
        return
    count, cells = values[memory.count], len(values[memory.value])
    due = -(-count // 8) if memory.bits else count
    if cells != due:
        raise ValueError(
            f"{spec.name}.{memory.count} is {count}, so the length of {memory.value} must be "
            f"{due}, not {cells}"
        )


def _by_register(
    protocol: Protocol, spec: InstructionSpec, given: dict[str, Any]
) -> dict[str, Any]:
    """The values with the fields of the instruction instead of names of registers."""
    memory = spec.writes or spec.reads
    cells = protocol.registers.get(memory.name) if memory else None
    if memory is None or cells is None or memory.blocks or not memory.at:
        return given
    places = {one.name: place for place, one in cells.items()}
    if spec.writes:
        named = {places[name]: cells[places[name]] for name in given if name in places}
        return _writing(spec, memory, named, given) if named else given
    asked = given.get(memory.at)
    if not isinstance(asked, str) or asked not in places or spec.answer is None:
        return given
    _, width = cells_in(memory, spec.answer)
    count = {memory.count: cells[places[asked]].size // width} if memory.count else {}
    return {**count, **given, memory.at: places[asked] // memory.factor}


def _writing(
    spec: InstructionSpec,
    memory: Memory,
    named: Mapping[int, FieldSpec],
    given: Mapping[str, Any],
) -> dict[str, Any]:
    """The values with the fields that write some registers, `named` by their places."""
    names = {one.name for one in named.values()}
    if memory.at in given or memory.value in given:
        raise ValueError(
            f"{spec.name} takes {memory.at} and {memory.value} or {' '.join(sorted(names))}, "
            "not both"
        )
    part, width = cells_in(memory, spec)
    first, built = min(named), b""
    for place in sorted(named):
        one = named[place]
        if place != first + len(built) // width:
            raise ValueError(
                f"{named[first].name} and {one.name} are not side by side; write each by a request "
                "of its own"
            )
        built += _built(spec.name, one, {one.name: given[one.name]})
    if not part.many and len(built) > width:
        raise ValueError(
            f"{' '.join(sorted(names))} takes {len(built) // width} cells of {memory.name}, and "
            f"{spec.name} writes one; use an instruction that writes several"
        )
    fields = {name: value for name, value in given.items() if name not in names}
    if memory.count in spec.names:
        fields[memory.count] = len(built) // width
    fields[memory.at] = first // memory.factor
    fields[memory.value] = built.hex() if part.many else part.parse(built)
    return fields


def free_parts(protocol: Protocol) -> Iterator[Part]:
    """The parts of a frame that whoever builds it chooses: the address, and other numbers."""
    return (part for part in protocol.layout.parts if part.role in ("address", "other"))


def _built_part(owner: str, part: Part, given: dict[str, Any]) -> int:
    """The value of a part of the frame besides its data, taken out of `given`."""
    if part.name not in given:
        if part.role == "other":
            return 0
        raise ValueError(
            f"{owner} needs {part.name}: {part.allowed}, for example {owner} {part.name}={part.low}"
        )
    value = given.pop(part.name)
    if part.role == "address" and not part.reaches(value):
        raise ValueError(f"{part.name} is {value!r}, allowed are {part.allowed}")
    if not isinstance(value, int) or not 0 <= value <= part.most:
        raise ValueError(f"{part.name} is {value!r}, allowed are 0 to {part.most}")
    return value


def _built(owner: str, part: FieldSpec, given: dict[str, Any]) -> bytes:
    """The bytes of a field, whose value is taken out of `given`.

    Bytes and several numbers may be in hex, and numbers the names of named values.
    """
    name, names = f"{owner}.{part.name}", dict(part.names)
    if part.name not in given:
        example = "01ff" if part.many else part.high
        allowed = "BYTES" if part.many else f"{part.low}..{part.high}"
        raise ValueError(
            f"{owner} needs {part.name}={allowed}, for example {owner} {part.name}={example}"
        )
    value = given.pop(part.name)
    try:
        if part.many is None:
            value = operator.index(names.get(value, value))
        elif part.element and isinstance(value, str):
            value = replace(part.many, prefix=None).parse(bytes.fromhex(value))
        elif names:
            value = [names.get(one, one) for one in value]
        if part.many:
            value = part.parse(part.build(value))
        if part.in_range(value):
            return part.build(value)
    except (ValueError, TypeError, OverflowError) as error:
        kinds, why = f"whole numbers from {part.low} to {part.high}", ""
        if part.many:
            kinds = "numbers, or their bytes in hex" if part.element else "bytes in hex"
            why = f" ({error})"
        raise ValueError(f"{name} is {value!r}, allowed are {kinds}{why}") from None
    raise ValueError(f"{name} is {shown_value(part, value)}, allowed are {part.allowed}")


def raw_frame(protocol: Protocol, identity: int, length: int, data: bytes = b"") -> bytes:
    """Build a raw frame, valid or not: a header of any ID and length, followed by any data.

    Raises ValueError for an ID or a length that no header can carry.
    """
    try:
        header = protocol.header_bytes[identity, length]
    except KeyError:
        raise ValueError(
            f"no header carries ID {identity} with length {length}; IDs go to "
            f"{protocol.ids[-1]}, lengths to {protocol.data_lengths[-1]}"
        ) from None
    return bytes([header]) + data


def all_data(spec: InstructionSpec) -> Iterable[bytes]:
    """Return valid data of an instruction, over the whole range of each field.

    One field takes each of its values while the others stay at their lowest; a field with more than
    256 values is sampled evenly, both ends included.
    """
    lowest = b"".join(part.build(part.low) for part in spec.fields)
    every = _one_by_one(spec, lambda part: map(part.build, _spread(part.low, part.high)))
    return {lowest: None, **every}


def bad_data(spec: InstructionSpec) -> Iterable[bytes]:
    """Return data of the right length with one field out of its range, over all values of it.

    A field with more than 256 values is sampled evenly, both ends included.
    """

    def wrong(part: FieldSpec) -> Iterator[bytes]:
        for value in _spread(0, 256**part.size - 1):
            coded = value.to_bytes(part.size, "big")
            if not part.low <= part.parse(coded) <= part.high:
                yield coded

    return _one_by_one(spec, wrong)


def _one_by_one(
    spec: InstructionSpec, values: Callable[[FieldSpec], Iterable[bytes]]
) -> dict[bytes, None]:
    """Data in which one field has each of some values and the others their lowest ones."""
    lowest = [part.build(part.low) for part in spec.fields]
    return {
        b"".join([*lowest[:place], value, *lowest[place + 1 :]]): None
        for place, part in enumerate(spec.fields)
        for value in values(part)
    }


def _spread(low: int, high: int, most: int = 256) -> Iterable[int]:
    count = high - low + 1
    if count <= most:
        return range(low, high + 1)
    return sorted({low + (high - low) * i // (most - 1) for i in range(most)})


def nearest(protocol: Protocol, frame: bytes, following: bytes = b"") -> bytes:
    """Return the valid frame that the sender most likely meant.

    `following` are bytes that came after the frame and may be its missing data. The frame with the
    fewest changed header bits is chosen, then that with the nearest ID. Missing data become zeros;
    values out of range are reduced to their named bits or to the nearest end of the range.
    """
    identity, _ = protocol.headers[frame[0]]
    if judge(protocol, frame).valid:
        return frame
    known = protocol.by_id.get(identity)
    data = frame[1:] + following
    candidates = [known] if known else list(protocol.instructions)
    meant = min(
        candidates,
        key=lambda spec: (
            (protocol.header_bytes[spec.id, spec.length] ^ frame[0]).bit_count(),
            abs(spec.id - identity),
            spec.id,
        ),
    )
    values = meant.decode(data[: meant.length].ljust(meant.length, b"\0"))
    for part in meant.fields:
        value = values[part.name] & part.high if part.bits else values[part.name]
        values[part.name] = min(max(value, part.low), part.high)
    return build(protocol, meant.name, values)


_REMEMBERED = 1 << 16  # frames


class Step(msgspec.Struct, frozen=True, gc=False):
    """One frame's judgement, and the state variables that it sets with their new values."""

    judgement: Judgement
    sets: Assigned


class Steps(dict[bytes, Step]):
    """The Step of each frame by its bytes (whole, or cut short): `steps[frame]`.

    At most 65,536 are remembered; then all are forgotten. Raises ValueError, as `codec.judge` does,
    for bytes that are not one frame.
    """

    def __init__(self, protocol: Protocol) -> None:
        super().__init__()
        self._protocol = protocol
        # By header and size: one header byte that no data can make right is judged once.
        self._whatever_data: dict[tuple[bytes, int], Step] = {}

    def __missing__(self, frame: bytes) -> Step:
        key = frame[:1], len(frame)
        known = self._whatever_data.get(key)
        if known is not None:
            return replace(known, judgement=replace(known.judgement, frame=frame))
        step = self._step(judge(self._protocol, frame))
        if self._protocol.plain and step.judgement.outcome not in _BY_DATA:
            self._whatever_data[key] = step
        if len(self) >= _REMEMBERED:
            self.clear()
        self[frame] = step
        return step

    def _step(self, judgement: Judgement) -> Step:
        effect = self._protocol.on_fault
        if judgement.valid and judgement.instruction:
            effect = judgement.instruction.effect
        return Step(judgement, assigned(effect, dict(judgement.fields)))
