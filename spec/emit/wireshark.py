"""Generates a Wireshark dissector in Lua: fields, verdicts, pairing and state of a grammar."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from itertools import product
from typing import Any, Literal

from bilprov.spec.emit.wireshark_program import PROGRAM
from bilprov.spec.errors import UserError
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import VARIABLES, Effect, Motion, is_moving
from bilprov.spec.protocol import FieldSpec, InstructionSpec, Protocol
from bilprov.spec.python_names import snake_case

_WIDTH = 72  # of a table on one line, without its name
_WIDEST = 6  # bytes of a field: Lua's numbers are exact up to 2^53

_HEAD = """\
-- Wireshark dissector of {title}: {document}
-- Grammar sha256 {sha256}.
-- Generated from the grammar by `bilprov spec emit wireshark`: change that, not this.
--
-- In Wireshark: put this file into the folder of personal Lua plugins, which Help > About
-- Wireshark > Folders names (on Linux and macOS ~/.local/lib/wireshark/plugins, on Windows
-- %APPDATA%\\Wireshark\\plugins), and open a file that bilprov has exported as pcapng. By itself it
-- takes every packet of the link type RTAC serial; Preferences > Protocols can turn that off.
--
-- In a terminal: tshark -2 -r FILE.pcapng -X lua_script:THIS_FILE -Y {word}.reason
-- (-2: two passes, since a frame cut short and a response are known only by later packets)
--
-- A packet may hold one frame, as in an exported file, or whatever one read gave: frames are put
-- together over packets, and a pause longer than the truncation time-out ends one."""


def lua_dissector(protocol: Protocol, skew: float) -> str:
    """Return the script's text, for Wireshark with Lua 5.1 to 5.4.

    `skew` is how long (ms) before its instruction an answer may be stamped, unless its user sets it
    otherwise. Raises UserError for a field that is not a plain integer of 1 to 6 bytes.
    """
    grammar = _grammar(protocol) | {"skew": round(skew * 1000)}
    head = _HEAD.format(
        title=_line(grammar["title"]),
        document=_line(protocol.document),
        sha256=protocol.sha256,
        word=grammar["word"],
    )
    return f"{head}\n\nlocal GRAMMAR = {_lua(grammar)}\n{PROGRAM}"


def _grammar(protocol: Protocol) -> dict[str, Any]:
    """Return all that the program knows of the protocol."""
    timing = protocol.timing
    return {
        "word": _word(protocol.name),
        "title": f"{protocol.name} {protocol.version}",
        "header": _header(protocol),
        "used": ", ".join(str(identity) for identity in protocol.by_id),
        "instructions": _instructions(protocol),
        "codes": {spec.code: spec.name for spec in protocol.responses},
        "outcomes": {
            outcome.name: {"words": outcome.value, "code": protocol.answers[outcome].code}
            for outcome in Outcome
        },
        "variables": list(VARIABLES),
        "power_on": {name: _plain(getattr(protocol.power_on, name)) for name in VARIABLES},
        "on_fault": _sets(protocol.on_fault, ()),
        "drives": {motion.value: True for motion in Motion if is_moving(motion, 1)},
        "truncation_timeout": round(timing.truncation_timeout * 1000),  # us; the others are in ms
        "truncation_longest": timing.truncation_longest,
        "answer_deadline": timing.answer_deadline,
        "answer_longest": timing.answer_longest,
    }


def _header(protocol: Protocol) -> dict[Any, Any]:
    """Return the parts of the header byte in order, and again by their names."""
    parts: dict[Any, dict[str, Any]] = {}
    shift = 8
    for place, (name, width, prose) in enumerate(protocol.header_bits, 1):
        shift -= width
        part = {"unit": 1 << shift, "size": 1 << width}
        parts[name] = part
        mask = (part["size"] - 1) * part["unit"]
        shown = {"word": name, "prose": prose, "mask": mask}
        if name == "id":
            known = {spec.id: spec.name for spec in protocol.instructions}
            shown["names"] = {identity: known.get(identity, "unused") for identity in protocol.ids}
        parts[place] = shown
    return parts


def _instructions(protocol: Protocol) -> dict[int, Any]:
    words = _distinct(((spec, spec.name) for spec in protocol.instructions), {"state", "expert"})
    return {spec.id: _instruction(word, spec) for word, spec in words.items()}


def _instruction(word: str, spec: InstructionSpec) -> dict[str, Any]:
    fields = _distinct((part, part.name) for part in spec.fields)
    return {
        "name": spec.name,
        "length": spec.length,
        "fields": [_field(f"{word}.{name}", spec, part) for name, part in fields.items()],
        "sets": _sets(spec.effect, spec.fields),
    }


def _field(word: str, spec: InstructionSpec, part: FieldSpec) -> dict[str, Any]:
    little, signed = _coding(spec, part)
    masks = [1 << place for place in reversed(range(len(part.bits)))]
    named = zip(part.bits, masks, strict=True)
    bits = _distinct((bit, bit[0]) for bit in named)
    return {
        "word": word,
        "name": part.name,
        "prose": part.prose,
        "offset": part.offset,
        "size": part.size,
        "low": part.low,
        "high": part.high,
        "little": little,
        "signed": signed,
        "modulus": 256**part.size,
        "bits": [
            {"word": short, "name": name, "mask": mask} for short, (name, mask) in bits.items()
        ],
    }


def _coding(spec: InstructionSpec, part: FieldSpec) -> tuple[bool, bool]:
    """Return whether a field is little-endian and whether it is signed, as its parser shows."""
    orders: tuple[Literal["big", "little"], ...] = ("big", "little")
    for order, signed in product(orders, (False, True)):
        if 0 < part.size <= _WIDEST and all(
            part.parse(raw) == int.from_bytes(raw, order, signed=signed)
            for raw in _samples(part.size)
        ):
            return order == "little", signed
    raise UserError(
        f"{spec.name}.{part.name} is not a plain integer of 1 to {_WIDEST} bytes, and a dissector "
        "in Lua can hold nothing else: give it such a field in the grammar"
    )


def _samples(size: int) -> Iterator[bytes]:
    """Yield data that tell the codings of integers apart: each value of each byte, among zeros."""
    yield bytes([0xFF]) * size
    for place in range(size):
        for value in range(256):
            yield bytes(place) + bytes([value]) + bytes(size - 1 - place)


def _sets(effect: Effect, fields: Iterable[FieldSpec]) -> dict[str, Any]:
    """Return the new value of each state variable, or the place of its field and the factor."""
    places = {part.name: place for place, part in enumerate(fields, 1)}
    return {
        variable: {"field": places[value[0]], "factor": value[1]}
        if isinstance(value, tuple)
        else _plain(value)
        for variable, value in effect.assignments
    }


def _plain(value: int | str) -> int | str:
    return str(value) if isinstance(value, str) else value


def _word(name: str) -> str:
    """Return a name as part of a display filter: RotateRight is rotate_right."""
    word = re.sub(r"[^a-z0-9]+", "_", snake_case(name, "x_"))
    return word.strip("_") or "x"


def _distinct(named: Iterable[tuple[Any, str]], taken: Iterable[str] = ()) -> dict[str, Any]:
    """Return values by the words of their names; a word that is taken gets an underscore."""
    words: dict[str, Any] = {}
    used = set(taken)
    for value, name in named:
        word = _word(name)
        while word in used:
            word += "_"
        used.add(word)
        words[word] = value
    return words


def _line(text: str) -> str:
    """Return text as one line, which no comment in Lua can be left by."""
    return " ".join(text.split())


def _lua(value: Any, indent: str = "") -> str:
    """Return a value as Lua source: dicts and lists are tables, on one line where it holds them."""
    if isinstance(value, dict | list):
        deeper = indent + "    "
        entries = (
            [f"{_key(key)} = {_lua(inner, deeper)}" for key, inner in value.items()]
            if isinstance(value, dict)
            else [_lua(inner, deeper) for inner in value]
        )
        line = "{ " + ", ".join(entries) + " }" if entries else "{}"
        if "\n" not in line and len(indent) + len(line) <= _WIDTH:
            return line
        return "{\n" + "".join(f"{deeper}{entry},\n" for entry in entries) + indent + "}"
    if isinstance(value, str):
        text = value.replace("\\", "\\\\").replace('"', '\\"')
        unseen = re.sub(r"[\x00-\x1f\x7f]", lambda found: f"\\{ord(found[0]):03d}", text)
        return f'"{unseen}"'
    return json.dumps(value)


def _key(key: int | str) -> str:
    return key if isinstance(key, str) else f"[{key}]"
