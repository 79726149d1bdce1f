"""Generates a Wireshark dissector in Lua: a grammar as tables, and the program that reads them.

The program is `dissector.lua`, for every grammar: it takes all that it knows of the protocol from
the table `GRAMMAR`. It runs in Lua 5.1 to 5.4: numbers are split by arithmetic, and written by
string.format, since 5.4 shows 3.0 where the older ones show 3.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any, TypeVar

from msgspec.structs import asdict, astuple

from bilprov.spec.data import DataSpec, FieldSpec
from bilprov.spec.emit.python import each_once, snake_case
from bilprov.spec.layout import Check, Layout
from bilprov.spec.protocol import NO_ANSWER, Protocol
from bilprov.spec.replies import GIVES_UP
from bilprov.spec.state import AllOf, Changed, Effect, From

T = TypeVar("T")

_WIDTH = 90  # of a table on one line
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
-- A number of more than 6 bytes is shown as bytes, whatever its range: Lua cannot hold it.
--
-- {packets}"""
_READS = """\
A packet may hold one frame, as in an exported file, or whatever one read gave: frames are put
-- together over packets, and a pause longer than the truncation time-out ends one."""
_FRAMES = "A packet holds one frame or one response, as in an exported file."


def lua_dissector(protocol: Protocol, skew: float, program: str) -> str:
    """Return the script's text, for Wireshark with Lua 5.1 to 5.4.

    `skew` is how long (ms) before its instruction an answer may be stamped, unless its user sets it
    otherwise; `program` is the text of the Lua program.
    """
    grammar = _grammar(protocol) | {"skew": round(skew * 1000)}  # us
    packets = _READS if protocol.plain else _FRAMES
    about = {"document": protocol.document, "sha256": protocol.sha256, "packets": packets}
    head = _HEAD.format_map({**grammar, **about})
    return f"{head}\n\nlocal GRAMMAR = {_lua(grammar)}\n\n{program}"


def _grammar(protocol: Protocol) -> dict[str, Any]:
    """Return all that the program knows of the protocol."""
    timing, at_rest = protocol.timing, protocol.at_rest
    rest = at_rest and {"all": isinstance(at_rest, AllOf), "values": at_rest.values}
    words = _by_word(((spec.name, spec) for spec in protocol.instructions), {"state", "expert"})
    return {
        "word": _word(protocol.name),
        "title": f"{protocol.name} {protocol.version}",
        "plain": protocol.plain,
        "frame": _laid_out(protocol.layout),
        "reply": _laid_out(protocol.reply, "Response" if protocol.plain else ""),
        "ack": _laid_out(protocol.acknowledgement, "Response" if protocol.plain else ""),
        "errors": [_laid_out(layout) for layout in protocol.errors],
        "instructions": {
            spec.id: {
                "word": word,
                "name": spec.name,
                "fields": _fields(spec),
                "answer": None if spec.answer is None else _answer_fields(protocol, spec.answer),
                "sets": _sets(spec.effect, spec.fields),
                **({"unchecked": True} if spec.id in protocol.layout.unchecked else {}),
            }
            for word, spec in words.items()
        },
        "ids": (dict.fromkeys(protocol.ids, "unused") if protocol.plain else {})
        | {spec.id: spec.name for spec in protocol.instructions},
        "used": ", ".join(map(str, protocol.by_id)),
        "codes": {spec.code: spec.name for spec in protocol.responses},
        "meanings": {
            spec.code: [one.value for one in spec.outcomes] for spec in protocol.responses
        },
        "flags": protocol.flags,
        # An outcome's word, the code that is due (None: none), whether it is answered at all.
        "outcomes": {
            one.name: [one.value, None if due.code < 0 else due.code, due is not NO_ANSWER]
            for one, due in protocol.answers.items()
        },
        "state": [
            {"word": f"state.{name}", "name": name, "kind": "STRING" if spec.words else "INT64"}
            for name, spec in protocol.variables.items()
        ],
        "power_on": {name: getattr(protocol.power_on, name) for name in protocol.variables},
        "on_fault": _sets(protocol.on_fault, ()),
        **({"at_rest": rest} if protocol.at_rest else {}),
        "truncation_timeout": round(timing.truncation_timeout * 1000),  # us
        "gives_up": round(timing.answer_deadline * 1000 / GIVES_UP),
        "truncation_longest": timing.truncation_longest,  # ms
        "answer_deadline": timing.answer_deadline,
        "answer_longest": timing.answer_longest,
    }


def _laid_out(layout: Layout, code: str = "") -> dict[str, Any]:
    """The parts of a layout; `code` is another name for the part that tells the outcome."""
    check = layout.check
    return {
        "head": layout.head,
        "tail": layout.tail,
        "has_data": layout.has_data,
        "parts": [
            asdict(part)
            | asdict(part.number)
            | {"number": None, "allowed": part.allowed, "word": _word(part.name)}
            | ({"name": code, "word": code.lower()} if code and part.role == "code" else {})
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
    for word, part in _by_word((part.name, part) for part in data.fields).items():
        many, number = part.many, part.element
        prefix = many.prefix if many else None
        row = {name: getattr(part, name) for name in ("name", "prose", "offset", "size", "code")}
        row |= {"low": part.low, "high": part.high, "allowed": part.allowed, "flags": part.mask}
        row |= {"order": number and number.order, "signed": bool(number and number.signed)}
        row |= {"count": many and many.how, "width": many.width if many else 0}
        row |= {"prefix": prefix.size if prefix else 0, "prefix_order": prefix and prefix.order}
        row |= {"names": {value: name for name, value in part.names} or None}
        row |= {"bits": _bits(part), "none": "off" if part.bits else "none"}
        rows.append(row | {"word": word, "constant": part.constant or b""})
    return rows


def _answer_fields(protocol: Protocol, data: DataSpec) -> list[dict[str, Any]]:
    """Return the fields of an answer, with what they report of the state."""
    told = {part.name: _reports(protocol, part) for part in data.fields if part.reports}
    return [row | {"reports": told.get(row["name"])} for row in _fields(data)]


def _reports(protocol: Protocol, part: FieldSpec) -> dict[str, Any]:
    """How a number becomes the value of the variable that it reports."""
    how = part.reports
    assert how is not None
    spec = protocol.variables[how.variable]
    numbers = {how.value(word, part.names): word for word in spec.words}
    words = {number: word for number, word in numbers.items() if number is not None}
    return {**how._asdict(), "low": spec.low, "high": spec.high, "words": words or None}


def _bits(part: FieldSpec) -> list[dict[str, Any]]:
    """The bits of a field that have names, or its flags."""
    letters = ((bit, 1 << place) for place, bit in enumerate(reversed(part.bits)))
    named = _by_word((name, (name, mask)) for name, mask in (*reversed([*letters]), *part.flags))
    return [{"word": word, "name": name, "mask": mask} for word, (name, mask) in named.items()]


def _sets(effect: Effect, fields: Iterable[FieldSpec]) -> dict[str, Any]:
    """Return the new value of each state variable, or how it is made.

    That is the place of its field and the factor, or 0 and a change of its old value.
    """
    places, found = {part.name: place for place, part in enumerate(fields, 1)}, {}
    for variable, value in effect.assignments:
        if isinstance(value, Changed):
            value = [0, *astuple(value)]
        elif isinstance(value, From):
            words = {known: word for word, known in value.words}
            value = {1: places[value.field], 2: value.factor, **({"words": words} if words else {})}
        found[variable] = value
    return found


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
