"""Generates a Wireshark dissector in Lua: a grammar as tables, and the program that reads them.

The program, `dissector.lua`, is the same for every grammar: it takes all that it knows of the
protocol from the table `GRAMMAR`. It runs in Lua 5.1 to 5.4: numbers are split by arithmetic, and
written by string.format, since 5.4 shows 3.0 where the older ones show 3.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any, TypeVar

from bilprov.spec.data import FieldSpec
from bilprov.spec.errors import UserError
from bilprov.spec.fields import OF_HEADERS
from bilprov.spec.numbers import Number
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.python_names import each_once, snake_case
from bilprov.spec.state import AllOf, Effect, FromField, FromOld

T = TypeVar("T")

_WIDTH = 90  # of a table on one line
_WIDEST = 6  # bytes of a field: Lua's numbers are exact up to 2^53
_UNSAFE = re.compile(r'[\x00-\x1f\x7f"\\]')  # in a string of Lua

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


def lua_dissector(protocol: Protocol, skew: float, program: str) -> str:
    """Return the script's text, for Wireshark with Lua 5.1 to 5.4.

    `skew` is how long (ms) before its instruction an answer may be stamped, unless its user sets it
    otherwise; `program` is the text of `dissector.lua`. Raises UserError for a field that is not a
    plain integer of 1 to 6 bytes.
    """
    grammar = _grammar(protocol) | {"skew": round(skew * 1000)}
    head = _HEAD.format_map({**grammar, "document": protocol.document, "sha256": protocol.sha256})
    return f"{head}\n\nlocal GRAMMAR = {_lua(grammar)}\n\n{program}"


def _grammar(protocol: Protocol) -> dict[str, Any]:
    """Return all that the program knows of the protocol; rows of fields are as it declares them."""
    timing = protocol.timing
    words = _by_word(((spec.name, spec) for spec in protocol.instructions), {"state", "expert"})
    power_on = {name: getattr(protocol.power_on, name) for name in protocol.variables}
    return {
        "word": _word(protocol.name),
        "title": f"{protocol.name} {protocol.version}",
        "header": list(_header(protocol)),
        "used": ", ".join(str(identity) for identity in protocol.by_id),
        "instructions": {spec.id: _instruction(word, spec) for word, spec in words.items()},
        "codes": {spec.code: spec.name for spec in protocol.responses},
        "outcomes": {one.name: [one.value, protocol.answers[one].code] for one in OF_HEADERS},
        "state": [
            _row("STRING" if spec.words else "INT64", f"state.{name}", name)
            for name, spec in protocol.variables.items()
        ],
        "power_on": power_on,
        "on_fault": _sets(protocol.on_fault, ()),
        **_at_rest(protocol),
        "truncation_timeout": round(timing.truncation_timeout * 1000),  # us; the others are in ms
        "truncation_longest": timing.truncation_longest,
        "answer_deadline": timing.answer_deadline,
        "answer_longest": timing.answer_longest,
    }


def _row(kind: str, word: str, name: str, **more: Any) -> dict[str, Any]:
    """Return a field of the dissector: its type, its word in display filters, its name."""
    return {"kind": kind, "word": word, "name": name, **more}


def _header(protocol: Protocol) -> Iterator[dict[str, Any]]:
    """Yield the parts of the header byte in order; a part is `header / unit % size`."""
    known = {identity: spec.name for identity, spec in protocol.by_id.items()}
    names = {"id": {"names": dict.fromkeys(protocol.ids, "unused") | known}}
    for part in protocol.layout.parts:
        size, unit, more = 1 << part.width, 1 << part.shift, names.get(part.name, {})
        numbers = {"unit": unit, "size": size, "mask": (size - 1) * unit}
        yield _row("UINT8", part.name, part.name, prose=part.prose, **numbers, **more)


def _instruction(word: str, spec: InstructionSpec) -> dict[str, Any]:
    fields = _by_word((part.name, part) for part in spec.fields)
    return {
        "name": spec.name,
        "length": spec.length,
        "fields": [_field(f"{word}.{name}", spec, part) for name, part in fields.items()],
        "sets": _sets(spec.effect, spec.fields),
    }


def _field(word: str, spec: InstructionSpec, part: FieldSpec) -> dict[str, Any]:
    number = _number(spec, part)
    little, signed = number.order == "little", number.signed
    kind = f"{'INT' if signed else 'UINT'}{8 * part.size if part.size <= 4 else 64}"
    numbers = {name: getattr(part, name) for name in ("offset", "size", "low", "high")}
    bits = _by_word((bit, (bit, 1 << len(part.bits) - at)) for at, bit in enumerate(part.bits, 1))
    more: dict[str, Any] = {"width": 8 * part.size, "names": ["on", "off"]}
    rows = [
        _row("BOOLEAN", f"{word}.{short}", bit, mask=mask, **more)
        for short, (bit, mask) in bits.items()
    ]
    return (
        _row(kind, word, part.name, prose=part.prose, little=little, signed=signed, bits=rows)
        | numbers
    )


def _number(spec: InstructionSpec, part: FieldSpec) -> Number:
    """Return how a field is written. Raises UserError for one that is too wide."""
    if part.number and part.size <= _WIDEST:
        return part.number
    raise UserError(
        f"{spec.name}.{part.name} is not a plain integer of 1 to {_WIDEST} bytes, and a dissector "
        "in Lua can hold nothing else: give it such a field in the grammar"
    )


def _sets(effect: Effect, fields: Iterable[FieldSpec]) -> dict[str, Any]:
    """Return the new value of each state variable, or how it is made.

    That is the place of its field and the factor, or 0 and a change of its old value.
    """
    places = {part.name: place for place, part in enumerate(fields, 1)}
    return {
        variable: [places[value.field], value.factor]
        if isinstance(value, FromField)
        else [0, *value]
        if isinstance(value, FromOld)
        else value
        for variable, value in effect.assignments
    }


def _at_rest(protocol: Protocol) -> dict[str, Any]:
    """When the device is at rest, where that is declared."""
    condition = protocol.at_rest
    if condition is None:
        return {}
    return {"at_rest": {"all": isinstance(condition, AllOf), "values": condition.values}}


def _word(name: str) -> str:
    """Return a name as part of a display filter: RotateRight is rotate_right."""
    return re.sub(r"[^a-z0-9]+", "_", snake_case(name, "x_")).strip("_") or "x"


def _by_word(named: Iterable[tuple[str, T]], reserved: Collection[str] = ()) -> Mapping[str, T]:
    return each_once(((_word(name), value) for name, value in named), reserved)


def _lua(value: Any, indent: str = "\n") -> str:
    """Return a value as Lua source: dicts and lists are tables, on one line where it holds them."""
    if isinstance(value, str):
        return '"' + _UNSAFE.sub(lambda found: f"\\{ord(found[0]):03d}", value) + '"'
    if value is None:  # which a table of Lua cannot hold
        return "false"
    if not isinstance(value, dict | list):
        return json.dumps(value)
    deeper = indent + "    "
    if isinstance(value, dict):
        keys = (f"{key} = " if isinstance(key, str) else f"[{key}] = " for key in value)
        entries = [
            key + _lua(inner, deeper) for key, inner in zip(keys, value.values(), strict=True)
        ]
    else:
        entries = [_lua(inner, deeper) for inner in value]
    line = f"{{ {', '.join(entries)} }}"
    if "\n" not in line and len(indent + line) <= _WIDTH:
        return line
    return "{" + "".join(f"{deeper}{entry}," for entry in entries) + indent + "}"
