"""Builds frames (valid and raw ones), judges a frame, and finds the nearest valid frame.

A judgement says which response a conforming device gives to the bytes, and why. It is the kit's own
reading of the document and does not depend on what any device answered.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping

import msgspec

from bilprov.spec.data import FieldSpec
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import InstructionSpec, Protocol, ResponseSpec


class Judgement(msgspec.Struct, frozen=True, gc=False):
    """The judgement of one frame: the response of a conforming device, and the reason.

    `frame` is the bytes as they came, `length` what the header announces, `instruction` is None
    for an unused ID, `fields` are the decoded data (empty unless the lengths are right). `valid` is
    true only for a complete frame without fault. `clause` and `reading` are what the reason rests
    on.
    """

    frame: bytes
    id: int
    length: int
    instruction: InstructionSpec | None
    fields: tuple[tuple[str, int], ...]
    outcome: Outcome
    response: ResponseSpec
    reason: str
    clause: str
    reading: str = ""

    @property
    def valid(self) -> bool:
        """Whether the frame is without fault."""
        return self.outcome is Outcome.VALID

    @property
    def truncated(self) -> bool:
        """Whether fewer data bytes came than the header announces."""
        return len(self.frame) <= self.length

    @property
    def name(self) -> str:
        """The instruction's name, or `unused` and the ID."""
        return self.instruction.name if self.instruction else f"unused {self.id}"

    def describe(self) -> str:
        """Return the frame in words: `LED rgb=5 (R B)`, `Stop`, `unused 9, 2 data bytes`."""
        if self.instruction and self.fields:
            specs = self.instruction.fields
            shown = [
                _value(spec, value) for spec, (_, value) in zip(specs, self.fields, strict=True)
            ]
            return f"{self.name} {' '.join(shown)}"
        if self.instruction and self.valid:
            return self.name
        arrived = len(self.frame) - 1
        if self.truncated:
            return f"{self.name}, {arrived} of {_bytes(self.length)}"
        return f"{self.name}, {_bytes(self.length)}"


def spaced(data: bytes) -> str:
    """Return bytes in hex as the kit shows them everywhere: `81 05`."""
    return data.hex(" ")


def _bytes(count: int) -> str:
    return "1 data byte" if count == 1 else f"{count} data bytes"


def bit_names(spec: FieldSpec, value: int) -> tuple[str, ...]:
    """Return the names of the field's set bits, most significant first."""
    top = len(spec.bits) - 1
    return tuple(name for i, name in enumerate(spec.bits) if value >> (top - i) & 1)


def _value(spec: FieldSpec, value: int) -> str:
    if not spec.bits or value > spec.high:
        return f"{spec.name}={value}"
    return f"{spec.name}={value} ({' '.join(bit_names(spec, value)) or 'off'})"


def judge(protocol: Protocol, frame: bytes) -> Judgement:
    """Judge one frame: a header with as many data bytes as it announces, or fewer (truncated).

    The header is judged first, then the length, then the data (R-unused-length,
    R-competing-errors). Raises ValueError for no bytes or for more than the header announces.
    """
    if not frame:
        raise ValueError("an empty frame cannot be judged; it needs at least a header byte")
    identity, length = protocol.headers[frame[0]]
    arrived = len(frame) - 1
    if arrived > length:
        raise ValueError(f"frame {spaced(frame)} has {_bytes(arrived)}, its header says {length}")
    instruction = protocol.by_id.get(identity)
    fields: tuple[tuple[str, int], ...] = ()
    clause, reading = protocol.clauses.instructions, ""
    if instruction is None:
        outcome = Outcome.UNKNOWN_ID
        used = ", ".join(str(i) for i in protocol.by_id)
        reason = f"no instruction has ID {identity}, used are {used}"
        reading = "R-truncated-unused" if arrived < length else "R-unused-length" if length else ""
    elif arrived < length:
        outcome = Outcome.TOO_FEW
        reason = f"{instruction.name}: {_bytes(length)} announced, {arrived} came"
        clause = protocol.clauses.responses
        reading = "R-truncated-long" if length > instruction.length else "R-truncated-known"
    elif length != instruction.length:
        outcome = Outcome.TOO_MANY if length > instruction.length else Outcome.TOO_FEW
        reason = f"{instruction.name} takes {_bytes(instruction.length)}, the header says {length}"
        clause = protocol.clauses.responses
        reading = "R-known-length"
    else:
        fields = tuple(instruction.decode(frame[1:]).items())
        outcome, reason = Outcome.VALID, ""
        for part, (_, value) in zip(instruction.fields, fields, strict=True):
            if outcome is Outcome.VALID and not part.low <= value <= part.high:
                outcome, reading = Outcome.BAD_DATA, part.reading
                reason = (
                    f"{instruction.name}.{part.name} is {value}, allowed are {part.low} to "
                    f"{part.high} (frame {spaced(frame)}, byte {1 + part.offset})"
                )
    return Judgement(
        frame=frame,
        id=identity,
        length=length,
        instruction=instruction,
        fields=fields,
        outcome=outcome,
        response=protocol.answers[outcome],
        reason=reason,
        clause=clause,
        reading=reading,
    )


def build(protocol: Protocol, name: str, fields: Mapping[str, int] | None = None) -> bytes:
    """Build a valid frame. `name` is an instruction in any case, `fields` its values by name.

    Raises ValueError, in one sentence, for an unknown instruction, a missing or unknown field, or
    a value out of its range.
    """
    given = dict(fields or {})
    spec = next((s for s in protocol.instructions if s.name.lower() == name.lower()), None)
    if spec is None:
        raise ValueError(
            f"there is no instruction {name!r}; there are "
            f"{', '.join(s.name for s in protocol.instructions)}"
        )
    data = b""
    for part in spec.fields:
        if part.name not in given:
            raise ValueError(
                f"{spec.name} needs {part.name}={part.low}..{part.high}, for example "
                f"{spec.name} {part.name}={part.high}"
            )
        value = given.pop(part.name)
        try:
            value = operator.index(value)
        except TypeError:
            raise ValueError(
                f"{spec.name}.{part.name} is {value!r}, allowed are whole numbers from {part.low} "
                f"to {part.high}"
            ) from None
        if not part.low <= value <= part.high:
            raise ValueError(
                f"{spec.name}.{part.name} is {value}, allowed are {part.low} to {part.high}"
            )
        data += part.build(value)
    if given:
        takes = ", ".join(part.name for part in spec.fields) or "no fields"
        raise ValueError(f"{spec.name} has no field {', '.join(given)}; it takes {takes}")
    return raw_frame(protocol, spec.id, len(data), data)


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


def all_data(spec: InstructionSpec, most: int = 256) -> Iterable[bytes]:
    """Return valid data of an instruction, over the whole range of each field.

    One field takes each of its values while the others stay at their lowest; a field with more than
    `most` values is sampled evenly, both ends included.
    """
    lowest = [part.low for part in spec.fields]
    seen: dict[bytes, None] = {b"".join(p.build(p.low) for p in spec.fields): None}
    for index, part in enumerate(spec.fields):
        for value in _spread(part.low, part.high, most):
            values = [*lowest[:index], value, *lowest[index + 1 :]]
            pairs = zip(spec.fields, values, strict=True)
            seen[b"".join(p.build(v) for p, v in pairs)] = None
    return seen


def bad_data(spec: InstructionSpec, most: int = 256) -> Iterable[bytes]:
    """Return data of the right length with one field out of its range, over all values of it.

    A field with more than `most` (at least 256) values is sampled evenly, both ends included.
    """
    seen: dict[bytes, None] = {}
    for index, part in enumerate(spec.fields):
        head = b"".join(p.build(p.low) for p in spec.fields[:index])
        tail = b"".join(p.build(p.low) for p in spec.fields[index + 1 :])
        for raw in _spread(0, 256**part.size - 1, max(most, 256)):
            coded = raw.to_bytes(part.size, "big")
            if not part.low <= part.parse(coded) <= part.high:
                seen[head + coded + tail] = None
    return seen


def _spread(low: int, high: int, most: int) -> Iterable[int]:
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
    padded = data[: meant.length].ljust(meant.length, b"\0")
    values = meant.decode(padded)
    return build(protocol, meant.name, {f.name: _cut(f, values[f.name]) for f in meant.fields})


def _cut(part: FieldSpec, value: int) -> int:
    if part.bits:
        value &= part.high
    return min(max(value, part.low), part.high)
