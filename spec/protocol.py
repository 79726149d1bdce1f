"""Loads a grammar into one frozen Protocol value; only this module reads construct objects.

The kit takes everything that it knows of the protocol from this value. It is loaded from the
grammar's text (the caller reads the file), and pickles as that text.
"""

from __future__ import annotations

import ast
import hashlib
import re
import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from math import prod
from typing import Any

from construct import BitsInteger, BitStruct, Construct, Renamed, Struct

from bilprov.spec.errors import UserError, one_line
from bilprov.spec.fields import (
    Answers,
    Clauses,
    From,
    Instruction,
    LineDefaults,
    Outcome,
    Ranged,
    Sets,
    Timing,
)
from bilprov.spec.motion import Effect, Motion, State
from bilprov.spec.value_checks import (
    WrongValue,
    require_name,
    require_text,
    require_whole,
    shown,
)

_LONGEST = 200  # characters of what Python says about a grammar, and of the name of its file
_MOST_FIELDS = 32  # of an instruction: the suite's frames grow with the square of their number


class GrammarError(UserError):
    """Raised for a grammar that cannot be used; the text is one sentence for the user."""


@dataclass(frozen=True, slots=True)
class FieldSpec:
    """One data field: its place in the data (bytes), its range, and the names of its bits.

    `reading` is the reading by which a value out of the range is bad data, "" if the document says
    it. `parse` and `build` convert between the field's bytes and its value.
    """

    name: str
    prose: str
    offset: int
    size: int
    low: int
    high: int
    bits: str
    reading: str
    parse: Callable[[bytes], int] = field(repr=False, compare=False)
    build: Callable[[int], bytes] = field(repr=False, compare=False)


@dataclass(frozen=True, slots=True)
class InstructionSpec:
    """One instruction: its ID, names, prose, data length in bytes, fields and effect."""

    id: int
    name: str
    document: str
    prose: str
    length: int
    fields: tuple[FieldSpec, ...]
    effect: Effect

    @property
    def valid_count(self) -> int:
        """How many valid frames there are."""
        return prod(part.high - part.low + 1 for part in self.fields)

    @property
    def bad_data_count(self) -> int:
        """How many frames of the right length there are whose data are out of range."""
        return int(256**self.length) - self.valid_count

    def decode(self, data: bytes) -> dict[str, int]:
        """The value of each field, in data at least as long as this instruction's."""
        return {part.name: part.parse(data[part.offset :][: part.size]) for part in self.fields}

    def in_range(self, data: bytes) -> bool:
        """Whether every field's value in such data is in its range."""
        values = self.decode(data)
        return all(part.low <= values[part.name] <= part.high for part in self.fields)


@dataclass(frozen=True, slots=True)
class ResponseSpec:
    """One response: its code, names, prose and the outcome it stands for."""

    code: int
    name: str
    document: str
    prose: str
    outcome: Outcome


@dataclass(frozen=True)
class Protocol:
    """The whole protocol as plain values.

    `source` is the grammar's text and `origin` its file name; two protocols are equal when their
    texts are. `headers` is the (ID, length) of each header byte, `header_bits` the (name, width in
    bits, prose) of each part of the header.
    """

    source: str
    origin: str = field(compare=False)
    name: str = field(compare=False)
    version: str = field(compare=False)
    document: str = field(compare=False)
    instructions: tuple[InstructionSpec, ...] = field(compare=False)
    responses: tuple[ResponseSpec, ...] = field(compare=False)
    headers: tuple[tuple[int, int], ...] = field(compare=False, repr=False)
    header_bits: tuple[tuple[str, int, str], ...] = field(compare=False)
    on_fault: Effect = field(compare=False)
    power_on: State = field(compare=False)
    timing: Timing = field(compare=False)
    line: LineDefaults = field(compare=False)
    clauses: Clauses = field(compare=False)

    def __reduce__(self) -> tuple[Any, ...]:
        return load, (self.source, self.origin)

    @cached_property
    def sha256(self) -> str:
        """The hash of the grammar's text."""
        return grammar_hash(self.source)

    @cached_property
    def by_id(self) -> Mapping[int, InstructionSpec]:
        """The instructions by their ID."""
        return {spec.id: spec for spec in self.instructions}

    @cached_property
    def by_name(self) -> Mapping[str, InstructionSpec]:
        """The instructions by their name."""
        return {spec.name: spec for spec in self.instructions}

    @cached_property
    def codes(self) -> Mapping[int, ResponseSpec]:
        """The responses by their code."""
        return {spec.code: spec for spec in self.responses}

    @cached_property
    def answers(self) -> Mapping[Outcome, ResponseSpec]:
        """The response for each outcome."""
        return {spec.outcome: spec for spec in self.responses}

    @cached_property
    def header_bytes(self) -> Mapping[tuple[int, int], int]:
        """The header byte of each (ID, length)."""
        return {split: byte for byte, split in enumerate(self.headers)}

    @cached_property
    def lengths(self) -> bytes:
        """For each header byte the number of data bytes it announces."""
        return bytes(length for _, length in self.headers)

    @cached_property
    def ids(self) -> range:
        """Every ID that a header can carry."""
        return range(max(identity for identity, _ in self.headers) + 1)

    @cached_property
    def data_lengths(self) -> range:
        """Every number of data bytes that a header can announce."""
        return range(max(self.lengths) + 1)

    @cached_property
    def unused_ids(self) -> tuple[int, ...]:
        """The IDs that no instruction has."""
        return tuple(identity for identity in self.ids if identity not in self.by_id)

    @cached_property
    def longest_frame(self) -> int:
        """The length of the longest frame in bytes, its header included."""
        return 1 + max(self.lengths)

    @cached_property
    def limits(self) -> Mapping[str, tuple[int, int]]:
        """The smallest and largest value that instructions can give each state variable.

        A variable that they only reset to 0 has none.
        """
        found: dict[str, list[int]] = {}
        for spec in self.instructions:
            ranges = {f.name: (f.low, f.high) for f in spec.fields}
            for variable, value in spec.effect.assignments:
                if isinstance(value, tuple):
                    ends = [end * value[1] for end in ranges[value[0]]]
                    found.setdefault(variable, []).extend(ends)
                elif value and isinstance(value, int):
                    found.setdefault(variable, []).append(value)
        return {variable: (min(ends), max(ends)) for variable, ends in found.items()}

    @cached_property
    def bounds(self) -> Mapping[str, tuple[int, int]]:
        """The smallest and largest value that each state variable with a number can ever have."""
        found = {
            variable: [value, *self.limits.get(variable, ())]
            for variable, value in asdict(self.power_on).items()
            if not isinstance(value, Motion)
        }
        for effect in (self.on_fault, *(spec.effect for spec in self.instructions)):
            for variable, value in effect.assignments:
                if isinstance(value, int):
                    found[variable].append(value)
        return {variable: (min(ends), max(ends)) for variable, ends in found.items()}

    @cached_property
    def stop(self) -> InstructionSpec:
        """The instruction without data that stops the robot; homing sends it."""
        return next(
            spec
            for spec in self.instructions
            if spec.effect.motion is Motion.STOPPED and not spec.length
        )

    @cached_property
    def pad_byte(self) -> int:
        """The header byte of `stop`, the only safe byte to pad with: read as a header, it stops."""
        return self.header_bytes[self.stop.id, 0]


# A grammar imports its names from `bilprov.spec`, an older one from `spec`. Both are the same
# grammar: the hash is taken over the older spelling, so that older recordings still match.
_BARE = re.compile(r"^from spec\.", re.MULTILINE)
_ONE_PACKAGE = re.compile(r"^from bilprov\.spec\.", re.MULTILINE)


def grammar_hash(source: str) -> str:
    """The SHA-256, in hex, by which the text of a grammar is known."""
    return hashlib.sha256(_ONE_PACKAGE.sub("from spec.", source).encode()).hexdigest()


def load(source: str, origin: str = "grammar") -> Protocol:
    """Read a grammar's text into a Protocol.

    `origin` is the file's name, used in messages. Raises GrammarError, in one sentence, for text
    that does not run or does not declare what a grammar must.
    """
    origin = one_line(origin, _LONGEST)
    space: dict[str, Any] = {"__name__": "grammar", "__file__": origin}
    try:
        with warnings.catch_warnings():  # Python's remarks about the text are not ours to print
            warnings.simplefilter("ignore")
            tree = ast.parse(_BARE.sub("from bilprov.spec.", source), origin)
            # dont_inherit: a grammar does not inherit this file's __future__ imports.
            code = compile(tree, origin, "exec", dont_inherit=True)
        exec(code, space)
    except WrongValue as error:
        raise GrammarError(
            f"the grammar {origin} cannot be used: {error}{_line(error, origin)}"
        ) from error
    except (Exception, SystemExit) as error:
        line = f", line {error.lineno}" if isinstance(error, SyntaxError) else ""
        what = one_line(error.msg if isinstance(error, SyntaxError) else error, _LONGEST)
        raise GrammarError(
            f"the grammar {origin} does not load: {type(error).__name__}: {what}{line}; "
            "start from a copy of spec/grammar.py"
        ) from error
    try:
        _require_each_id_once(tree)
        return _read(space, source, origin)
    except (GrammarError, WrongValue) as error:
        raise GrammarError(f"the grammar {origin} cannot be used: {error}") from None
    except Exception as error:  # construct raises many kinds for declarations that make no sense
        raise GrammarError(
            f"the grammar {origin} cannot be used: {one_line(error, _LONGEST)}; "
            "compare it with spec/grammar.py"
        ) from error


def _line(error: BaseException, origin: str) -> str:
    """Where in the grammar an error comes from, in words; none if that is not known."""
    trace, line = error.__traceback__, 0
    while trace:
        if trace.tb_frame.f_code.co_filename == origin:
            line = trace.tb_lineno
        trace = trace.tb_next
    return f" (line {line})" if line else ""


def _require_each_id_once(tree: ast.Module) -> None:
    """Raise GrammarError for a number that stands twice: Python silently drops one of them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Dict):
            keys = [key.value for key in node.keys if isinstance(key, ast.Constant)]
            twice = _twice(keys)
            if twice is not None:
                raise GrammarError(
                    f"the number {shown(twice)} stands twice in line {node.lineno} and on"
                )


def _read(space: dict[str, Any], source: str, origin: str) -> Protocol:
    headers, header_bits = _headers(_take(space, "HEADER", Construct))
    longest = max(length for _, length in headers)
    declared = _take(space, "INSTRUCTIONS", dict)
    carried = {identity for identity, _ in headers}
    for identity in declared:
        require_whole("an ID in INSTRUCTIONS", identity)
        if identity not in carried:
            raise GrammarError(f"the header cannot carry the ID {identity}")
    instructions = tuple(_instruction(i, declared[i], longest) for i in sorted(declared))
    _require_each_name_once("two instructions are named", (spec.name for spec in instructions))
    if not any(s.effect.motion is Motion.STOPPED and not s.length for s in instructions):
        raise GrammarError("no instruction without data stops the robot; the kit needs one to home")
    response = _take(space, "RESPONSE", Answers)
    if response.sizeof() != 1:
        raise GrammarError("RESPONSE must be one byte")
    responses = tuple(
        ResponseSpec(code, answer.name, answer.document, answer.prose, answer.outcome)
        for code, answer in sorted(response.answers.items())
    )
    _require_each_name_once("two responses are named", (spec.name for spec in responses))
    missing = [o.value for o in Outcome if o not in {spec.outcome for spec in responses}]
    if missing:
        raise GrammarError(f"no response stands for {', '.join(missing)}")
    _require_each_name_once("two responses stand for", (o.outcome.value for o in responses))
    _require_bare_frame(_take(space, "FRAME", Construct))
    on_fault = _effect(_take(space, "FAULTY", Sets), ())
    if on_fault.motion is not Motion.STOPPED:
        raise GrammarError(
            "FAULTY does not set motion to Motion.STOPPED; a faulty instruction must stop the robot"
        )
    power_on = _effect(_take(space, "POWER_ON", Sets), ()).apply(State())
    if power_on.motion is not Motion.STOPPED:
        raise GrammarError(
            f"POWER_ON sets motion to {power_on.motion.value}; a robot must stand still at power-on"
        )
    return Protocol(
        source=source,
        origin=origin,
        name=_text(space, "NAME"),
        version=_text(space, "VERSION"),
        document=_text(space, "DOCUMENT"),
        instructions=instructions,
        responses=responses,
        headers=headers,
        header_bits=header_bits,
        on_fault=on_fault,
        power_on=power_on,
        timing=_take(space, "TIMING", Timing),
        line=_take(space, "LINE", LineDefaults),
        clauses=_take(space, "CLAUSES", Clauses),
    )


def _take(space: dict[str, Any], name: str, kind: type) -> Any:
    """Return the declaration of that name. Raises GrammarError if it is not of that kind."""
    if name not in space:
        raise GrammarError(f"it declares no {name}")
    if not isinstance(space[name], kind):
        raise GrammarError(f"{name} is a {type(space[name]).__name__}, not a {kind.__name__}")
    return space[name]


def _text(space: dict[str, Any], name: str) -> str:
    """Return the text of that name."""
    text: str = _take(space, name, str)
    require_text(name, text)
    return text


def _headers(
    header: BitStruct,
) -> tuple[tuple[tuple[int, int], ...], tuple[tuple[str, int, str], ...]]:
    """Return (ID, length) of every header byte, and (name, width in bits, prose) of each part."""
    if header.sizeof() != 1:
        raise GrammarError(f"HEADER is {shown(header.sizeof())} bytes long; it must be one byte")
    struct = getattr(header, "subcon", None)
    members: list[Construct] = struct.subcons if isinstance(struct, Struct) else []
    if sorted(str(part.name) for part in members) != ["id", "length"]:
        raise GrammarError("HEADER must have the parts id and length")
    for part in members:
        bits = _unwrap(part)
        if type(bits) is not BitsInteger or bits.signed or bits.swapped:
            raise GrammarError(f"HEADER.{part.name} must be written BitsInteger(width)")
        require_whole(f"the width of HEADER.{part.name}", bits.length, 1, 8)
        require_text(f"the prose of HEADER.{part.name}", _prose(part))
    parts = tuple((part.name, part.sizeof(), _prose(part)) for part in members)
    bits = sum(width for _, width, _ in parts)
    if bits != 8:
        raise GrammarError(f"the parts of HEADER have {bits} bits together; they must have 8")
    parsed = [header.parse(bytes([byte])) for byte in range(256)]
    return tuple((one.id, one.length) for one in parsed), parts


def _require_bare_frame(frame: Construct) -> None:
    """Raise GrammarError for a FRAME that is more than header and data: no other part is read."""
    members: list[Construct] = frame.subcons if isinstance(frame, Struct) else []
    names = [str(part.name) for part in members]
    if names != ["header", "data"]:
        parts = ", ".join(map(shown, names)) if names else "none"
        raise GrammarError(
            f"the parts of FRAME are {parts}; allowed are header and data, without a sync or a "
            "checksum around them"
        )


def _twice(values: Iterable[Hashable]) -> Any:
    """Return the first value that stands twice, None if there is none."""
    return next((value for value, count in Counter(values).items() if count > 1), None)


def _require_each_name_once(what: str, names: Iterable[str]) -> None:
    """Raise GrammarError for a name that stands twice in any case: users may write any."""
    by_name: dict[str, str] = {}
    for name in names:
        if name.lower() in by_name:
            raise GrammarError(f"{what} {by_name[name.lower()]}")
        by_name[name.lower()] = name


def _prose(declaration: Construct) -> str:
    return declaration.docs if isinstance(declaration, Renamed) else ""


def _unwrap(declaration: Construct) -> Construct:
    while isinstance(declaration, Renamed):
        declaration = declaration.subcon
    return declaration


def _instruction(identity: int, declaration: Construct, longest: int) -> InstructionSpec:
    body = _unwrap(declaration)
    if not isinstance(body, Instruction) or not declaration.name:
        raise GrammarError(f'instruction {identity} must be written "Name" / Instruction(...)')
    name = declaration.name
    require_name(f"the name of instruction {identity}", name)
    require_text(f"the prose of {name}", _prose(declaration))
    if len(body.subcons) > _MOST_FIELDS:
        raise GrammarError(f"{name} has {len(body.subcons)} fields, allowed are {_MOST_FIELDS}")
    fields: list[FieldSpec] = []
    for member in body.subcons:
        fields.append(_field(name, member, sum(part.size for part in fields)))
    _require_each_name_once(f"{name} has two fields named", (part.name for part in fields))
    length = sum(part.size for part in fields)
    if length > longest:
        raise GrammarError(f"{name} has {length} data bytes; a header announces at most {longest}")
    return InstructionSpec(
        id=identity,
        name=name,
        document=body.document,
        prose=_prose(declaration),
        length=length,
        fields=tuple(fields),
        effect=_effect(body.effect, tuple(spec.name for spec in fields)),
    )


def _field(instruction: str, member: Construct, offset: int) -> FieldSpec:
    require_name(f"the name of a field of {instruction}", member.name)
    name = f"{instruction}.{member.name}"
    require_text(f"the prose of {name}", _prose(member))
    ranged = _unwrap(member)
    if not isinstance(ranged, Ranged):
        raise GrammarError(f"{name} has no range: write Ranged(Byte, low, high)")
    size = ranged.sizeof()
    require_whole(f"the size of {name} in bytes", size, 1, 255)
    _require_whole_numbers(name, ranged, size)
    low, high = ranged.low, ranged.high
    if low > high:
        raise GrammarError(f"{name} has the range {low} to {high}, which holds nothing")
    if len(ranged.bits) > 8 * size:
        raise GrammarError(f"{name} names {len(ranged.bits)} bits, it has {8 * size}")
    return FieldSpec(
        name=member.name,
        prose=_prose(member),
        offset=offset,
        size=size,
        low=low,
        high=high,
        bits=ranged.bits,
        reading=ranged.reading,
        parse=ranged.subcon.parse,
        build=ranged.subcon.build,
    )


def _require_whole_numbers(name: str, ranged: Ranged, size: int) -> None:
    """Raise GrammarError unless any bytes are a whole number, and both ends of the range bytes."""
    inner = ranged.subcon
    try:
        for raw in (bytes(size), b"\xff" * size):
            value = inner.parse(raw)
            if type(value) is not int or inner.build(value) != raw:
                raise GrammarError(f"{name} is not a whole number")
    except Exception as error:
        raise GrammarError(f"the type of {name} must be a whole number, such as Byte") from error
    try:
        inner.build(ranged.low)
        inner.build(ranged.high)
    except Exception:
        raise GrammarError(f"{name} cannot carry its range {ranged.low} to {ranged.high}") from None


def _effect(sets: Sets, fields: tuple[str, ...]) -> Effect:
    assignments: list[tuple[str, int | Motion | tuple[str, int]]] = []
    for variable, value in sets.values.items():
        if isinstance(value, From):
            if value.field not in fields:
                raise GrammarError(f"an effect names the field {value.field}, which is not there")
            if variable == "motion":
                raise GrammarError("an effect sets motion to a number, allowed is a Motion")
            assignments.append((variable, (value.field, value.factor)))
        elif variable == "motion":
            motion = next((motion for motion in Motion if motion == value), None)
            if motion is None:
                raise GrammarError(f"an effect sets motion to {shown(value)}, allowed is a Motion")
            assignments.append((variable, motion))
        else:
            require_whole(f"what an effect sets {variable} to", value)
            assignments.append((variable, int(value)))
    return Effect(tuple(assignments))
