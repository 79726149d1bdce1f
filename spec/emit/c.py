"""Generates a C header with the protocol's constants, for firmware and hosts written in C."""

from __future__ import annotations

import re
from collections.abc import Iterator

from bilprov.spec.data import FieldSpec
from bilprov.spec.fields import OF_HEADERS
from bilprov.spec.protocol import InstructionSpec, Protocol

Line = tuple[str, str, str]
"""A constant: its name, its value and its description."""


def c_header(protocol: Protocol) -> str:
    """Return the header's text (C90 and C++): constants only, all with the protocol's prefix."""
    prefix = _word(protocol.name)
    if not prefix[:1].isalpha():
        prefix = f"P_{prefix}"
    taken: set[str] = set()
    parts = [
        ("The frame", _frame(protocol)),
        *(
            (f"{spec.id}: {spec.name}", _instruction(protocol, spec))
            for spec in protocol.instructions
        ),
        (
            "Answers, one byte each",
            (
                (f"ANSWER_{_word(one.name)}", _hex(one.code), one.prose)
                for one in protocol.responses
            ),
        ),
        (
            "Which answer is due",
            ((f"ON_{one.name}", _hex(protocol.answers[one].code), "") for one in OF_HEADERS),
        ),
        ("Times in ms, and the line", _times(protocol)),
    ]
    lines = [
        f"/* {_plain(protocol.document)}",
        f" * {_plain(protocol.name)} {_plain(protocol.version)}, grammar sha256 {protocol.sha256}",
        " * Generated from the grammar by `bilprov spec emit c`: change that, not this. */",
        f"#ifndef {prefix}_PROTOCOL_H",
        f"#define {prefix}_PROTOCOL_H",
    ]
    for title, constants in parts:
        lines += ["", f"/* {_plain(title)} */"]
        for name, value, prose in constants:
            while name in taken:  # names may differ in characters that C has not
                name += "_"
            taken.add(name)
            comment = f" /* {_plain(prose)} */" if prose else ""
            lines.append(f"#define {prefix}_{name} {value}{comment}")
    return "\n".join([*lines, "", "#endif", ""])


def _frame(protocol: Protocol) -> Iterator[Line]:
    shift = 8
    for name, width, prose in protocol.header_bits:
        shift -= width
        yield f"{_word(name)}_SHIFT", str(shift), prose
        yield f"{_word(name)}_MASK", _hex(((1 << width) - 1) << shift), ""
    yield "MAX_DATA", str(max(protocol.lengths)), "data bytes that a header can announce"
    yield "MAX_FRAME", str(protocol.longest_frame), "bytes of the longest frame"
    yield "FILLER", _hex(protocol.pad_byte), "the only byte that is safe to pad with: it stops"


def _instruction(protocol: Protocol, spec: InstructionSpec) -> Iterator[Line]:
    name = _word(spec.name)
    yield f"{name}_ID", str(spec.id), spec.prose
    yield f"{name}_LENGTH", str(spec.length), "data bytes"
    yield name, _hex(protocol.header_bytes[spec.id, spec.length]), "header byte"
    for field in spec.fields:
        yield from _field(name, field)


def _field(instruction: str, field: FieldSpec) -> Iterator[Line]:
    name = f"{instruction}_{_word(field.name)}"
    yield f"{name}_OFFSET", str(field.offset), field.prose
    if field.size != 1:
        yield f"{name}_SIZE", str(field.size), "bytes"
    yield f"{name}_MIN", str(field.low), ""
    yield f"{name}_MAX", str(field.high), ""
    for place, bit in enumerate(reversed(field.bits)):
        yield f"{name}_{_word(bit)}", _hex(1 << place), ""


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


def _plain(text: str) -> str:
    """Return text that can neither end a C comment nor begin another."""
    return " ".join(text.split()).replace("*/", "* /").replace("/*", "/ *")
