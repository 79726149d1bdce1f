"""Generates a Wireshark dissector in Lua: a grammar as tables, and the program that reads them.

The program is `dissector.lua` for the robot car and its family, and `framed.lua` for all others. It
takes all that it knows of the protocol from the table `GRAMMAR`. It runs in Lua 5.1 to 5.4: numbers
are split by arithmetic, and written by string.format, since 5.4 shows 3.0 where the older ones show
3.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import asdict
from typing import Any, TypeVar

from bilprov.spec.data import DataSpec, FieldSpec
from bilprov.spec.errors import UserError
from bilprov.spec.fields import OF_HEADERS, Outcome
from bilprov.spec.layout import Check, Layout
from bilprov.spec.numbers import Number
from bilprov.spec.protocol import NO_ANSWER, InstructionSpec, Protocol
from bilprov.spec.python_names import each_once, snake_case
from bilprov.spec.replies import GIVES_UP
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
-- {packets}"""
_READS = """\
A packet may hold one frame, as in an exported file, or whatever one read gave: frames are put
-- together over packets, and a pause longer than the truncation time-out ends one."""
_FRAMES = "A packet holds one frame or one response, as in an exported file."


def lua_dissector(protocol: Protocol, skew: float, program: str) -> str:
    """Return the script's text, for Wireshark with Lua 5.1 to 5.4.

    `skew` is how long (ms) before its instruction an answer may be stamped, unless its user sets it
    otherwise; `program` is the text of the Lua program. Raises UserError for a grammar of the car's
    family with a field that is not a plain integer of 1 to 6 bytes.
    """
    grammar = _grammar(protocol) if protocol.plain else _framed(protocol)
    grammar["skew"] = round(skew * 1000)
    packets = _READS if protocol.plain else _FRAMES
    about = {"document": protocol.document, "sha256": protocol.sha256, "packets": packets}
    head = _HEAD.format_map({**grammar, **about})
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


def _framed(protocol: Protocol) -> dict[str, Any]:
    """Return all that the program `framed.lua` knows of the protocol."""
    words = _by_word(((spec.name, spec) for spec in protocol.instructions), {"expert"})
    return {
        "word": _word(protocol.name),
        "title": f"{protocol.name} {protocol.version}",
        "frame": _laid_out(protocol.layout),
        "reply": _laid_out(protocol.reply),
        "ack": _laid_out(protocol.acknowledgement),
        "errors": [_laid_out(layout) for layout in protocol.errors],
        "instructions": {
            spec.id: {
                "word": word,
                "name": spec.name,
                "fields": _fields(spec.data),
                "answer": None if spec.answer is None else _fields(spec.answer),
            }
            for word, spec in words.items()
        },
        "ids": {spec.id: spec.name for spec in protocol.instructions},
        "used": ", ".join(map(str, protocol.by_id)),
        "codes": {spec.code: spec.name for spec in protocol.responses},
        "flags": protocol.flags,
        "outcomes": {
            one.name: [one.value, protocol.answers[one] is not NO_ANSWER] for one in Outcome
        },
        "gives_up": round(protocol.timing.answer_deadline * 1000 / GIVES_UP),  # us
        "answer_deadline": protocol.timing.answer_deadline,  # ms
        "answer_longest": protocol.timing.answer_longest,
    }


def _laid_out(layout: Layout) -> dict[str, Any]:
    check = layout.check
    return {
        "head": layout.head,
        "tail": layout.tail,
        "has_data": layout.has_data,
        "parts": [
            asdict(part) | asdict(part.number) | {"word": _word(part.name), "number": None}
            for part in layout.parts
        ],
        "check": check and _check(check),
    }


def _check(check: Check) -> dict[str, Any]:
    places = {name: getattr(check, name) for name in ("first", "last", "asked")}
    return {"kind": type(check.function).__name__, **asdict(check.function), **places}


def _fields(data: DataSpec) -> list[dict[str, Any]]:
    """Return the fields of some data; those that are counted have a `count`, how that is done."""
    rows = []
    for part in data.fields:
        many = part.many
        number = many.element if many else part.number
        prefix = many.prefix if many else None
        row = {name: getattr(part, name) for name in ("name", "prose", "offset", "size")}
        row |= {"low": part.low, "high": part.high, "mask_of_flags": part.mask}
        row |= {"order": number and number.order, "signed": bool(number and number.signed)}
        row |= {"count": many and many.how, "width": many.width if many else 0}
        row |= {"prefix": prefix.size if prefix else 0, "prefix_order": prefix and prefix.order}
        row |= {"names": {value: name for name, value in part.names} or None}
        rows.append(row | {"word": _word(part.name), "constant": part.constant or b""})
    return rows


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
    value = list(value) if isinstance(value, bytes) else value
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
