"""Grammars whose frames have any layout, drawn by seed: sync, address, length, fields, check, end.

The text is plain construct, which judges what the kit makes of it.
"""

from __future__ import annotations

from random import Random
from typing import Any, NamedTuple

from construct import Construct

from bilprov.spec.protocol import InstructionSpec, Protocol, load

_IMPORTS = """\
from construct import (
    Array, BitsInteger, BitStruct, Byte, Bytes, BytesInteger, Checksum, Const, Enum, FixedSized,
    FlagsEnum, GreedyBytes, GreedyRange, Int8sb, Int16sb, Int16ub, Int16ul, Int24sl, Int24ub,
    Int32sl, Int64ub, Int64sl, Pass, Prefixed, PrefixedArray, RawCopy, Struct, Switch, this,
)
from bilprov.spec.fields import (
    Address, Answer, Answers, Clauses, Crc, Data, Fletcher, Instruction, Length, LineDefaults,
    Outcome, Ranged, Same, Sum, Timing, Xor, asked,
)

NAME, VERSION, DOCUMENT = "drawn", "1", "none"
"""

_NUMBERS = (
    *("Byte", "Int16ub", "Int16ul", "Int24ub", "Int32sl", "Int16sb", "Ranged(Byte, 3, 200)"),
    *(
        "Ranged(Int16sb, -300, 500)",
        "Enum(Byte, off=0, on=1, other=9)",
        "FlagsEnum(Byte, a=1, b=8)",
    ),
    *("Array(2, Int16ub)", "Bytes(3)", "Int8sb", "Int24sl", "Int64sl", "Int64ub"),
    *("BytesInteger(5)", "BytesInteger(6, signed=True, swapped=True)"),
    *("Enum(Int16ul, off=0, on=1, other=9)", "FlagsEnum(Int24ub, a=1, b=8)"),
    *("Array(2, Enum(Byte, off=0, on=1, other=9))", "Array(3, FlagsEnum(Int16ub, a=1, b=8))"),
    "Array(2, Ranged(Int16sb, -300, 500))",
)
_NIBBLE = '"flag" / BitsInteger(6), "address" / Address(BitsInteger(4), 1, 14, broadcast=0)'
_ID, _ECHO = '"id" / Byte', '"id" / Same("id", Byte)'
_COUNTED = (
    *("Prefixed(Byte, GreedyRange(Int16ub))", "Prefixed(Byte, GreedyBytes)"),
    "PrefixedArray(Byte, Enum(Int16ul, off=0, on=1, other=9))",
)
_CHECKS = (
    *(("Byte", f"Sum(8, complement={flag})") for flag in (0, 1)),
    *(("Byte", "Xor()"), ("Byte", "Xor(0x5A)"), ("Int16ub", "Sum(16)"), ("Byte", "Crc(8, 0xD5)")),
    *(("Int16ul", "Crc(16, 0x8005, 0xFFFF, reflected=True)"), ("Int16ub", "Crc(16, 0x1021)")),
    *(("Int16ul", "Fletcher()"), ("Byte", "Crc(7, 0x09, reflected=True)")),
    *(("Byte", "Crc(3, 0x3, xorout=0x7)"), ("Int16ul", "Crc(12, 0x80F, refout=True)")),
    ("Int32sl", None),
)


class DrawnLayout(NamedTuple):
    """A drawn grammar, loaded, and its constructs by name."""

    text: str
    protocol: Protocol
    frame: Construct
    reply: Construct


def drawn_layout(seed: int) -> DrawnLayout:
    """The grammar of this seed."""
    draw = Random(f"layout {seed}")
    text = _text(draw)
    space: dict[str, Any] = {}
    exec(text, space)
    return DrawnLayout(text, load(text, f"drawn{seed}.py"), space["FRAME"], space["REPLY"])


def drawn_values(draw: Random, protocol: Protocol, spec: InstructionSpec) -> dict[str, Any]:
    """Values in their ranges for the parts and the fields of an instruction's frame."""
    values: dict[str, Any] = {}
    for part in protocol.layout.parts:
        if part.role == "address":
            values[part.name] = draw.randint(part.low, part.high)
        if part.role == "other":
            values[part.name] = draw.randint(0, part.most)
    return values | drawn_fields(draw, spec)


def drawn_fields(draw: Random, data: Any) -> dict[str, Any]:
    """Values in their ranges for some fields; a counting field counts what it must."""
    values: dict[str, Any] = {}
    for part in data.fields:
        if part.constant is not None:
            continue
        many = part.many
        if many is None:
            values[part.name] = draw.choice(_allowed(part))
            continue
        count = many.fixed or draw.randint(0, 5)
        if many.how == "expression":
            values["size"] = count
        numbers = tuple(
            draw.randint(part.low, part.high) if part.unlimited else draw.choice(_allowed(part))
            for _ in range(count)
        )
        values[part.name] = numbers if many.element else bytes(numbers)
    return values


def _allowed(part: Any) -> list[int]:
    if part.names:
        return [value for _, value in part.names]
    if part.flags:
        return [0, *(mask for _, mask in part.flags), sum(mask for _, mask in part.flags)]
    return [part.low, part.high, (part.low + part.high) // 2]


def _text(draw: Random) -> str:
    sync = bytes(draw.sample(range(256), draw.choice((0, 0, 1, 2))))
    has_length, has_address = draw.random() < 0.5, draw.random() < 0.5
    has_check = draw.random() < 0.7
    bits = draw.random() < 0.25
    end = bytes([draw.randrange(256)]) if draw.random() < 0.3 else b""
    check = draw.choice([one for one in _CHECKS if one[1]])
    head = _head(draw, has_length=has_length, has_address=has_address, bits=bits)
    switch = f"Switch(this.{'h.' if bits else ''}id, INSTRUCTIONS)"
    length_of = "this.h.length" if bits else "this.length"
    data = f"FixedSized({length_of}, {switch})" if has_length else switch
    told = f"FixedSized({length_of}, Data())" if has_length else "Data()"
    covered = [*head, f'"data" / {data}']
    replied = [*map(_echoed, head), '"code" / RESPONSE', f'"data" / {told}']
    checked = f"Checksum({check[0]}, {check[1]}, this.covered.data)" if has_check else ""
    reply = _around(sync, replied, checked, end)
    identities = sorted(draw.sample(range(8 if bits else 250), draw.randint(1, 5)))
    unchecked = [one for one in identities if draw.random() < 0.2]
    if has_check and not end and unchecked:
        path = f"this.covered.value.{'h.' if bits else ''}id"
        cases = ", ".join(f"{one}: Pass" for one in unchecked)
        checked = f"Switch({path}, {{{cases}}}, default={checked})"
    frame = _around(sync, covered, checked, end)
    instructions = "".join(
        _instruction(draw, place, identity, has_length=has_length)
        for place, identity in enumerate(identities)
    )
    return (
        f"{_IMPORTS}INSTRUCTIONS = {{\n{instructions}}}\n"
        'RESPONSE = Answers(Byte, {6: Answer("OK", Outcome.VALID, "", "done"), '
        '21: Answer("NO", (Outcome.UNKNOWN_ID, Outcome.BAD_DATA), "", "not done")})\n'
        f"FRAME = {frame}\nREPLY = {reply}\n"
        "SILENT = (Outcome.TOO_MANY, Outcome.TOO_FEW, Outcome.BAD_CHECKSUM, Outcome.BAD_SYNC)\n"
        "TIMING = Timing(truncation_timeout=50, truncation_shortest=5, truncation_longest=1000, "
        "answer_deadline=100, answer_longest=1000, stop_longest=100)\n"
        'LINE = LineDefaults(baud=9600, parity="N", stopbits=1)\n'
        'CLAUSES = Clauses(header="1", instructions="2", responses="3", safety="4")\n'
    )


def _head(draw: Random, *, has_length: bool, has_address: bool, bits: bool) -> list[str]:
    """The parts before the data, in a drawn order."""
    if bits and has_length:
        parts = ['"h" / BitStruct("id" / BitsInteger(3), "length" / BitsInteger(5))']
    elif bits and has_address:
        parts = [f'"h" / BitStruct(Const(5, BitsInteger(3)), "id" / BitsInteger(3), {_NIBBLE})']
        has_address = False
    elif bits:
        parts = ['"h" / BitStruct("id" / BitsInteger(3), "flag" / BitsInteger(5))']
    else:
        parts = ['"id" / Byte']
        if has_length:
            kind, also = draw.choice(("Byte", "Int16ub", "Int16ul")), draw.choice((0, 0, 2))
            parts.append(f'"length" / Length({kind}, also={also})')
    if has_address:
        parts.append('"address" / Address(Byte, 1, 99, broadcast=0)')
    if draw.random() < 0.3:
        parts.append('"number" / Int16ub')
    draw.shuffle(parts)
    return parts


def _echoed(part: str) -> str:
    """The part of an answer that stands for a part of the request."""
    part = part.replace("Address(Byte, 1, 99, broadcast=0)", 'Same("address", Byte, plus=200)')
    part = part.replace(
        "Address(BitsInteger(4), 1, 14, broadcast=0)", 'Same("address", BitsInteger(4), plus=9)'
    )
    return part.replace(_ID, _ECHO)


def _around(sync: bytes, parts: list[str], checked: str, end: bytes) -> str:
    inner = ", ".join(parts)
    front = [f'"sync" / Const({sync!r})'] if sync else []
    behind = [f'"end" / Const({end!r})'] if end else []
    if not checked:
        return f"Struct({', '.join([*front, inner, *behind])})"
    covered = f'"covered" / RawCopy(Struct({inner}))'
    check = f'"check" / {checked}'
    return f"Struct({', '.join([*front, covered, check, *behind])})"


def _instruction(draw: Random, place: int, identity: int, *, has_length: bool) -> str:
    fields = _fields(draw, has_length=has_length)
    answer = _fields(draw, has_length=has_length) if draw.random() < 0.6 else []
    told = f", answer=Struct({', '.join(answer)})" if answer else ""
    listed = "".join(f"{one}, " for one in fields)
    return f'    {identity}: "Do{place}" / Instruction({listed}document=""{told}) * "Does it.",\n'


def _fields(draw: Random, *, has_length: bool) -> list[str]:
    """Some fields; the last one may be counted."""
    count = draw.randint(0, 3)
    fields = [f'"f{n}" / {draw.choice(_NUMBERS)} * "a value"' for n in range(count)]
    kinds = [*_COUNTED, "expression"] + (["GreedyBytes"] if has_length else [])
    if draw.random() < 0.5:
        kind = draw.choice(kinds)
        if kind == "expression":
            counted = draw.choice(("Bytes(this.size)", "Array(this.size, Int16ub)"))
            return ['"size" / Byte', *fields, f'"many" / {counted}']
        fields.append(f'"many" / {kind}')
    return fields
