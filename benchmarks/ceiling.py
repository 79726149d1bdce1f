"""A C loop on the header that `bilprov spec emit c` writes, compiled on the spot: the ceiling."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from bilprov.spec.emit.c import c_header
from bilprov.spec.motion import VARIABLES, Effect, Motion
from bilprov.spec.protocol import FieldSpec, InstructionSpec, Protocol

INSTALL = "no cc: apt-get install gcc libc6-dev"
MOTIONS = tuple(Motion)
_SOURCE = Path(__file__).with_name("ceiling.c")


class Judged(NamedTuple):
    """What a decoder made of a buffer: the response code due to each frame, and the last state."""

    codes: bytes
    state: tuple[str | int, ...]

    def summary(self) -> list[object]:
        """How many frames each response is due to, and the last state, as values of JSON."""
        counts = {str(code): self.codes.count(code) for code in sorted(set(self.codes))}
        return [counts, list(self.state)]


class Ceiling:
    """The compiled loop of one protocol, with room for a buffer of `most` bytes.

    Raises FileNotFoundError without a C compiler, ValueError for a grammar whose fields or state
    the loop has no room for.
    """

    def __init__(self, protocol: Protocol, folder: Path, most: int) -> None:
        compiler = shutil.which("cc") or shutil.which("gcc")
        if compiler is None:
            raise FileNotFoundError(INSTALL)
        (folder / "protocol.h").write_text(c_header(protocol), encoding="utf-8")
        (folder / "judge.h").write_text(_judge(protocol), encoding="utf-8")
        library = folder / "ceiling.so"
        subprocess.run(
            [compiler, "-O2", "-shared", "-fPIC", f"-I{folder}", "-o", library, _SOURCE],
            check=True,
        )
        self._library = ctypes.CDLL(str(library))
        self._library.power_on.restype = ctypes.c_uint64
        self._library.decode.restype = ctypes.c_size_t
        self._library.prepare()
        self._codes = (ctypes.c_uint8 * most)()
        self._states = (ctypes.c_uint64 * most)()
        self._state = ctypes.c_uint64()
        self.reset()

    def reset(self) -> None:
        """Begin again from power-on."""
        self._state.value = self._library.power_on()

    def decode(self, data: bytes) -> tuple[int, int]:
        """Judge the whole frames of data; returns how many there are, and their bytes."""
        used = ctypes.c_size_t()
        count = self._library.decode(
            *(data, ctypes.c_size_t(len(data)), self._codes, self._states),
            *(ctypes.byref(self._state), ctypes.byref(used)),
        )
        return int(count), used.value

    def judged(self, data: bytes) -> Judged:
        """The result for data from power-on on."""
        self.reset()
        count, _ = self.decode(data)
        values = (ctypes.c_int16 * len(VARIABLES)).from_buffer_copy(self._state)
        named = dict(zip(VARIABLES, values, strict=True))
        state = tuple(MOTIONS[v] if n == "motion" else v for n, v in named.items())
        return Judged(bytes(memoryview(self._codes)[:count]), state)


def _judge(protocol: Protocol) -> str:
    """The part of the loop that depends on the grammar."""
    names = _Names(protocol)
    cases = [line for spec in protocol.instructions for line in _header_case(names, spec)]
    lengths = [line for spec in protocol.instructions for line in _length_case(names, spec)]
    begin = Effect(tuple((name, getattr(protocol.power_on, name)) for name in VARIABLES))
    return "\n".join(
        [
            '#include "protocol.h"',
            f"#define FRAME_MOST {names['MAX_FRAME']}",
            "static void power_on_state(State *state)",
            "{",
            *_effect(begin, {}),
            "}",
            "static uint8_t length_of(uint8_t header)",
            "{",
            f"    return (header & {names['LENGTH_MASK']}) >> {names['LENGTH_SHIFT']};",
            "}",
            "static uint8_t judge(const uint8_t *frame, State *state)",
            "{",
            f"    uint8_t code = {names['ON_BAD_DATA']}, length = length_of(frame[0]);",
            "    switch (frame[0]) {",
            *cases,
            "    default:",
            f"        switch ((frame[0] & {names['ID_MASK']}) >> {names['ID_SHIFT']}) {{",
            *lengths,
            f"        default: code = {names['ON_UNKNOWN_ID']};",
            "        }",
            "    }",
            *_effect(protocol.on_fault, {}),
            "    return code;",
            "}",
            "",
        ]
    )


class _Names:
    """The constants' names in the header; KeyError for one that it does not define."""

    def __init__(self, protocol: Protocol) -> None:
        defined: list[str] = re.findall(r"^#define (\w+) \S", c_header(protocol), re.MULTILINE)
        prefix = next(name for name in defined if name.endswith("_ID_SHIFT"))[: -len("ID_SHIFT")]
        self._names = {_plain(name.removeprefix(prefix)): name for name in defined}

    def __getitem__(self, name: str) -> str:
        return self._names[_plain(name)]


def _plain(name: str) -> str:
    """A name without what an instruction's and a constant's spelling differ in."""
    return re.sub(r"[^A-Z0-9]", "", name.upper())


def _header_case(names: _Names, spec: InstructionSpec) -> Iterator[str]:
    yield f"    case {names[spec.name]}: {{"
    for place, part in enumerate(spec.fields):
        name = spec.name + part.name
        yield f"        long f{place} = {_value(part, names[name + 'OFFSET'])};"
        low, high = names[name + "MIN"], names[name + "MAX"]
        yield f"        if (f{place} < {low} || f{place} > {high}) break;"
    fields = {part.name: f"f{place}" for place, part in enumerate(spec.fields)}
    yield from _effect(spec.effect, fields)
    yield f"        return {names['ON_VALID']};"
    yield "    }"


def _length_case(names: _Names, spec: InstructionSpec) -> Iterator[str]:
    more, less = names["ON_TOO_MANY"], names["ON_TOO_FEW"]
    length = names[spec.name + "LENGTH"]
    yield f"        case {names[spec.name + 'ID']}:"
    yield f"            code = length > {length} ? {more} : {less};"
    yield "            break;"


def _value(part: FieldSpec, offset: str) -> str:
    """The C expression of a field's value, an unsigned number in either order of bytes."""
    if part.size > 1 and part.parse(bytes([1, *bytes(part.size - 1)])) == 1:
        shifts = range(0, 8 * part.size, 8)
    else:
        shifts = range(8 * (part.size - 1), -8, -8)
    if part.parse(b"\xff" * part.size) != 256**part.size - 1:
        raise ValueError(f"the C loop reads unsigned numbers only, and {part.name} is none")
    return " | ".join(f"(long)frame[1 + {offset} + {i}] << {s}" for i, s in enumerate(shifts))


def _effect(effect: Effect, fields: dict[str, str]) -> Iterator[str]:
    for variable, value in effect.assignments:
        if isinstance(value, tuple):
            yield f"        state->is.{variable} = {fields[value[0]]} * {value[1]};"
        else:
            number = MOTIONS.index(value) if isinstance(value, Motion) else value
            yield f"        state->is.{variable} = {number};"
