"""Generates a C header with the protocol's constants, for firmware and hosts written in C."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping

from msgspec.structs import asdict

from bilprov.spec.data import DataSpec, FieldSpec, Number
from bilprov.spec.layout import Check, Layout, Part
from bilprov.spec.protocol import InstructionSpec, Protocol

_WIDEST = 4  # bytes of a number that C90 has for sure

Line = tuple[str, str, str]
"""A constant: its name, its value and its description."""


def c_header(protocol: Protocol) -> str:
    """Return the header's text (C90 and C++): constants only, all with the protocol's prefix."""
    prefix = _word(protocol.name)
    if not prefix[:1].isalpha():
        prefix = f"P_{prefix}"
    taken: set[str] = set()
    lines = [
        f"/* {_plain(protocol.document)}",
        f" * {_plain(protocol.name)} {_plain(protocol.version)}, grammar sha256 {protocol.sha256}",
        " * Generated from the grammar by `bilprov spec emit c`: change that, not this. */",
        f"#ifndef {prefix}_PROTOCOL_H",
        f"#define {prefix}_PROTOCOL_H",
    ]
    for title, constants in _sections(protocol):
        lines += ["", f"/* {_plain(title)} */"]
        for name, value, prose in constants:
            while name in taken:  # names may differ in characters that C has not
                name += "_"
            taken.add(name)
            comment = f" /* {_plain(prose)} */" if prose else ""
            lines.append(f"#define {prefix}_{name} {value}{comment}")
    return "\n".join([*lines, "", "#endif", ""])


def _frame(protocol: Protocol) -> Iterator[Line]:
    for part in protocol.layout.parts:
        yield f"{_word(part.name)}_SHIFT", str(part.shift), part.prose
        yield f"{_word(part.name)}_MASK", _hex(((1 << part.width) - 1) << part.shift), ""
    yield "MAX_DATA", str(max(protocol.lengths)), "data bytes that a header can announce"
    yield "MAX_FRAME", str(protocol.longest_frame), "bytes of the longest frame"
    if protocol.stop_or_none:
        yield "FILLER", _hex(protocol.pad_byte), "the only byte that is safe to pad with: it stops"


def _sections(protocol: Protocol) -> Iterator[tuple[str, Iterable[Line]]]:
    """Yield the sections of the header: titles with the lines of each."""
    if protocol.plain:
        yield "The frame", _frame(protocol)
    else:
        yield "A request", _layout("FRAME", protocol.layout)
        yield "An answer", _layout("REPLY", protocol.reply)
        if protocol.acknowledgement != protocol.reply:
            yield "An answer without data", _layout("ACK", protocol.acknowledgement)
        for at, layout in enumerate(protocol.errors):
            yield "An error", _layout(f"ERROR{at or ''}", layout)
    for spec in protocol.instructions:
        yield f"{spec.id}: {spec.name}", _instruction(protocol, spec)
    codes = [(f"ANSWER_{_word(one.name)}", _hex(one.code), one.prose) for one in protocol.responses]
    yield "Answers, one byte each" if protocol.plain else "Codes of answers", codes
    due = [(one.name, spec.code) for one, spec in protocol.answers.items() if spec.code >= 0]
    yield "Which answer is due", [(f"ON_{name}", _hex(code), "") for name, code in due]
    for name, cells in protocol.registers.items():
        yield f"Named cells of {name}", _registers(cells)
    yield "Times in ms, and the line", _times(protocol)


def _layout(what: str, layout: Layout) -> Iterator[Line]:
    yield f"{what}_HEAD", str(layout.head), "bytes in front of the data"
    yield f"{what}_TAIL", str(layout.tail), "bytes behind the data"
    for part in layout.parts:
        yield from _part(f"{what}_{_word(part.name) or 'CONSTANT'}", part)
    if layout.check:
        yield from _check(f"{what}_CHECK", layout.check)


def _part(name: str, part: Part) -> Iterator[Line]:
    place = "OFFSET" if part.offset >= 0 else "FROM_END"
    yield f"{name}_{place}", str(abs(part.offset)), part.prose
    if part.constant:
        yield f"{name}_BYTES", _bytes(part.constant), ""
        return
    yield from _number(name, part.number)
    if part.width:
        yield f"{name}_SHIFT", str(part.shift), ""
        yield f"{name}_MASK", _hex((1 << part.width) - 1 << part.shift), ""
    if part.role == "constant":
        yield f"{name}_VALUE", str(part.low), ""
    if part.role == "address" and not part.same:
        yield f"{name}_MIN", str(part.low), ""
        yield f"{name}_MAX", str(part.high), ""
        if part.broadcast is not None:
            yield f"{name}_BROADCAST", str(part.broadcast), ""
    if part.also:
        yield f"{name}_ALSO", str(part.also), "bytes that it counts besides the data"
    if part.plus:
        yield f"{name}_PLUS", _hex(part.plus), f"added to {part.same} of the request"


def _number(name: str, number: Number) -> Iterator[Line]:
    if number.size != 1:
        yield f"{name}_SIZE", str(number.size), "bytes"
        yield f"{name}_LITTLE_ENDIAN", str(int(number.order == "little")), ""
    if number.signed:
        yield f"{name}_SIGNED", "1", ""


def _check(name: str, check: Check) -> Iterator[Line]:
    yield f"{name}_FIRST", str(check.first), "the first byte that it counts"
    yield f"{name}_LAST", str(check.last), "bytes at the end of the frame that it does not count"
    if check.asked:
        yield f"{name}_ASKED", "1", "what the request's counts stands before them"
    for word, value in asdict(check.function).items():
        yield f"{name}_{type(check.function).__name__.upper()}_{word.upper()}", _hex(value), ""


def _instruction(protocol: Protocol, spec: InstructionSpec) -> Iterator[Line]:
    name = _word(spec.name)
    yield f"{name}_ID", str(spec.id), spec.prose
    at_least = " at least" if spec.counted else ""
    yield f"{name}_LENGTH", str(spec.length), f"data bytes{at_least}"
    if spec.id in protocol.layout.unchecked:
        yield f"{name}_UNCHECKED", "1", "nothing stands behind its data"
    if protocol.plain:
        yield name, _hex(protocol.header_bytes[spec.id, spec.length]), "header byte"
    for field in spec.fields:
        yield from _field(name, field)
    for field in (spec.answer or DataSpec()).fields:
        yield from _field(f"{name}_ANSWER", field)


def _field(owner: str, field: FieldSpec) -> Iterator[Line]:
    name = f"{owner}_{_word(field.name) or 'CONSTANT'}"
    yield f"{name}_OFFSET", str(field.offset), field.prose
    if field.constant is not None:
        yield f"{name}_BYTES", _bytes(field.constant), ""
    if field.many:
        yield f"{name}_ELEMENT", str(field.many.width), "bytes of each element"
    if field.many and field.many.prefix:
        counted = field.many.how.split()[0]
        yield f"{name}_COUNT_SIZE", str(field.many.prefix.size), f"in front, counts {counted}"
    yield from _values(name, field)


def _values(name: str, field: FieldSpec) -> Iterator[Line]:
    """Yield how a number, or each of several, is written, its range and its names."""
    number = field.number
    if field.many:
        number, name = field.many.element, f"{name}_ELEMENT"
    if number is None:
        return
    yield from _number(name, number)
    if number.size <= _WIDEST:
        yield f"{name}_MIN", _decimal(field.low), ""
        yield f"{name}_MAX", _decimal(field.high), ""
    for word, value in (*field.names, *field.flags):
        yield f"{name}_{_word(word)}", _hex(value), ""
    for place, bit in enumerate(reversed(field.bits)):
        yield f"{name}_{_word(bit)}", _hex(1 << place), ""


def _registers(cells: Mapping[int, FieldSpec]) -> Iterator[Line]:
    for place, cell in cells.items():
        name = f"REGISTER_{_word(cell.name)}"
        yield name, str(place), cell.prose
        yield from _values(name, cell)


def _times(protocol: Protocol) -> Iterator[Line]:
    timing, line = protocol.timing, protocol.line
    timeout = f"{timing.truncation_timeout:g}"
    yield "TRUNCATION_TIMEOUT_MS", timeout, "a pause inside a frame ends it"
    yield "ANSWER_DEADLINE_MS", f"{timing.answer_deadline:g}", ""
    yield "STOP_LONGEST_MS", f"{timing.stop_longest:g}", "after a faulty instruction"
    yield "BAUD", str(line.baud), f"parity {line.parity}, {line.stopbits:g} stop bit"


def _word(name: str) -> str:
    """Return a name as part of a C constant: RotateRight is ROTATE_RIGHT."""
    parted = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)
    return re.sub(r"[^A-Za-z0-9]+", "_", parted).strip("_").upper()


def _hex(value: int) -> str:
    return f"0x{value:02x}"


def _decimal(value: int) -> str:
    """A number that is one in C90: the lowest long has no literal, and large ones are unsigned."""
    if value == -(1 << 31):
        return f"({value + 1} - 1)"
    return str(value) if value < 1 << 31 else _hex(value)


def _bytes(raw: bytes) -> str:
    """Bytes as they initialise an array of C."""
    return f"{{ {', '.join(map(_hex, raw))} }}"


def _plain(text: str) -> str:
    """Return text that can neither end a C comment nor begin another."""
    return " ".join(text.split()).replace("*/", "* /").replace("/*", "/ *")
