"""Splits a judged frame into groups of bits and says what each group means."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from bilprov.spec.codec import Judgement
from bilprov.spec.protocol import FieldSpec, InstructionSpec, Protocol


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
