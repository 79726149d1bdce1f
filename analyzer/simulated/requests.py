"""Draws valid requests of any grammar by a seed: for simulated traffic, and for tests."""

from __future__ import annotations

from random import Random

from bilprov.spec.codec import judge
from bilprov.spec.data import FieldSpec
from bilprov.spec.protocol import InstructionSpec, Protocol

_ADDRESSES = 3  # devices that are spoken to
_MOST = 8  # elements of a field that nothing counts
_LONGEST = 240  # bytes of data


def drawn_request(protocol: Protocol, chance: Random) -> bytes:
    """A valid request to one of a few devices; small numbers are likelier than large ones."""
    spec = chance.choice(protocol.instructions)
    layout = protocol.layout
    parts = {"id": spec.id}
    for part in layout.parts:
        if part.role == "address":
            parts[part.name] = chance.randint(part.low, min(part.high, part.low + _ADDRESSES - 1))
    while len(data := _data(spec, chance)) > _LONGEST:
        pass  # what the length of a frame cannot count is drawn again
    return layout.build(parts, data)


def faulty_request(protocol: Protocol, chance: Random) -> bytes:
    """A request with a wrong bit in its last byte, where that is its check or a constant.

    Where a header byte is all that stands around the data, any header and data that are not valid.
    """
    while protocol.plain:
        header = chance.randrange(len(protocol.headers))
        frame = bytes([header]) + chance.randbytes(protocol.lengths[header])
        if not judge(protocol, frame).valid:
            return frame
    frame = drawn_request(protocol, chance)
    last = protocol.layout.parts[-1] if protocol.layout.tail else None
    if last is None or last.role not in ("check", "constant"):
        return frame
    return frame[:-1] + bytes([frame[-1] ^ 1 << chance.randrange(8)])


def _data(spec: InstructionSpec, chance: Random) -> bytes:
    built, numbers = b"", dict[str, int]()
    for part in spec.fields:
        if part.constant is not None:
            built += part.constant
        elif part.many is not None:
            built += part.build(_elements(spec, part, built, numbers, chance))
        else:
            numbers[part.name] = _number(part, chance)
            built += part.build(numbers[part.name])
    return built


def _number(part: FieldSpec, chance: Random) -> int:
    if part.names:
        return chance.choice(part.names)[1]
    if part.flags:
        return sum(mask for _, mask in part.flags if chance.random() < 0.5)
    return part.low + int(part.count ** chance.random()) - 1


def _elements(
    spec: InstructionSpec, part: FieldSpec, before: bytes, numbers: dict[str, int], chance: Random
) -> bytes | tuple[int, ...]:
    """The value of a field of bytes or of several numbers, as many as the others ask for."""
    many = part.many
    assert many is not None
    count = chance.randint(1, _MOST)
    if many.how == "fixed":
        count = many.fixed
    elif many.how == "expression":
        count = ((spec.data.measure(before) or len(before)) - len(before)) // many.width
    elif spec.writes and spec.writes.value == part.name and spec.writes.count in numbers:
        count = numbers[spec.writes.count]
        count = -(-count // 8) if spec.writes.bits else count
    if many.element is None:
        return chance.randbytes(count)
    return tuple(chance.randint(many.element.low, many.element.high) for _ in range(count))
