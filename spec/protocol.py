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
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Annotated, Any

import msgspec
from construct import Construct, FixedSized, Struct, Switch
from msgspec import Meta
from msgspec.structs import replace

from bilprov.spec import grammar
from bilprov.spec.data import DataSpec, FieldSpec, prose_of, read_data, read_register, unwrapped
from bilprov.spec.errors import UserError, WrongValue, one_line, require, require_word, shown
from bilprov.spec.fields import (
    Answers,
    Clauses,
    Data,
    Instruction,
    LineDefaults,
    Memory,
    Natural,
    Outcome,
    Sets,
    Timing,
)
from bilprov.spec.layout import Layout, read_layout
from bilprov.spec.motion import Moment, Wheels
from bilprov.spec.state import (
    Changed,
    Condition,
    Effect,
    From,
    Request,
    Source,
    State,
    Step,
    Unknown,
    Variables,
    VariableSpec,
    assigned,
    plain,
    state_class,
    ways_on,
)

_LONGEST_DATA = 255  # bytes of data that are expected where a header byte does not bound them
_LONGEST = 200  # characters of what Python says about a grammar, and of the name of its file


# The built-in text is the same grammar as the first one, which did not declare the state: whatever
# holds the hash of that one still matches, such as recordings, profiles and reports.
_FIRST = "784fbb0b76e02c6703df30b623f9ed0d040db9d062dba0396b23863fe89ae234"
# The hashes of the texts that say the same.
_SAME_AS_FIRST = {"8a0bb1c6b82900a82100364dd82df18e11664e7845861b36995caedf8583c18d"}


_NEAR = 0.8  # how alike two names are of which one is a slip of the other

Title = Annotated[str, Meta(min_length=1)]


class _Grammar(msgspec.Struct, frozen=True):
    """What a grammar declares, by name."""

    FRAME: Construct
    INSTRUCTIONS: Mapping[int, Construct]
    NAME: Title
    VERSION: Title
    DOCUMENT: Title
    TIMING: Timing
    LINE: LineDefaults
    CLAUSES: Clauses
    DEVICE: str = ""
    RESPONSE: Answers | None = None
    REPLY: Construct | None = None
    ACK: Construct | None = None
    ERROR: Any = ()
    SILENT: tuple[Outcome, ...] = ()
    STATE: Variables | None = None
    AT_REST: Condition | None = None
    WHEELS: Wheels | None = None
    FAULTY: Sets | None = None
    POWER_ON: Sets | None = None
    MEMORY: tuple[Memory, ...] = ()
    REGISTERS: Mapping[str, Mapping[Natural, Construct]] = {}


# The kinds of values that have no use under another name.
_KINDS = {
    "STATE": Variables,
    "AT_REST": Condition,
    "WHEELS": Wheels,
    "TIMING": Timing,
    "LINE": LineDefaults,
    "CLAUSES": Clauses,
}


class GrammarError(UserError):
    """Raised for a grammar that cannot be used; the text is one sentence for the user."""


class InstructionSpec(DataSpec, frozen=True, kw_only=True):
    """One instruction: its ID, names, prose, data, effect, and the data of its answer.

    `answer` is None where it is not answered at all. `writes` and `reads` are the memory that it
    writes, and that its answer tells. `changes` names what else it changes that the state does not
    have, "" if there is no such thing, None if that is not said.
    """

    id: int
    name: str
    document: str
    prose: str
    effect: Effect
    answer: DataSpec | None
    writes: Memory | None = None
    reads: Memory | None = None
    changes: str | None = None

    @property
    def names(self) -> frozenset[str]:
        """The names of its fields."""
        return frozenset(part.name for part in self.fields)

    @property
    def bad_data_count(self) -> int:
        """How many frames of the right length there are whose data are out of range."""
        return int(256**self.length) - self.valid_count

    def in_range(self, data: bytes) -> bool:
        """Whether every field's value in such data is in its range."""
        return self.wrong(data) is None


class ResponseSpec(msgspec.Struct, frozen=True):
    """One response: its code, names, prose and the outcomes it stands for.

    `code` is -1 where the answer has none.
    """

    code: int
    name: str
    document: str
    prose: str
    outcomes: tuple[Outcome, ...]

    @property
    def outcome(self) -> Outcome | None:
        """The outcome that it stands for, the first of several; None if it stands for none."""
        return self.outcomes[0] if self.outcomes else None


PLAIN_ANSWER = ResponseSpec(-1, "answer", "", "an answer without a code", (Outcome.VALID,))
"""What a valid frame gets where the answers of valid frames have no code."""

NO_ANSWER = ResponseSpec(-1, "no answer", "", "nothing is answered", ())
"""What a frame gets that is not answered."""


class Protocol(msgspec.Struct, frozen=True, eq=False, dict=True):
    """The whole protocol as plain values.

    `source` is the grammar's text and `origin` its file name; two protocols are equal when their
    texts are. `layout` is that of a request, `reply` that of an answer with data,
    `acknowledgement` that of one without, `errors` those of errors, tried in order. With `flags` a
    code is some bits, each a response. `device` is the noun for the device. `registers` are the
    cells with names, by the name of their memory and their place in it. `variables` are the
    parts of the state by name, `at_rest` is the condition in which the device stands still (None
    where it is not declared: then nothing is said about stopping), `wheels` is declared by a car.
    """

    source: str
    origin: str
    name: str
    version: str
    document: str
    instructions: tuple[InstructionSpec, ...]
    responses: tuple[ResponseSpec, ...]
    layout: Layout
    reply: Layout
    acknowledgement: Layout
    errors: tuple[Layout, ...]
    flags: bool
    device: str
    registers: Mapping[str, Mapping[int, FieldSpec]]
    variables: Mapping[str, VariableSpec]
    at_rest: Condition | None
    wheels: Wheels | None
    on_fault: Effect
    power_on: State
    timing: Timing
    line: LineDefaults
    clauses: Clauses

    def __reduce__(self) -> tuple[Any, ...]:
        return load, (self.source, self.origin)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Protocol) and self.source == other.source

    def __ne__(self, other: object) -> bool:  # a Struct has one of its own
        return not self == other

    def __hash__(self) -> int:
        return hash(self.source)

    @cached_property
    def sha256(self) -> str:
        """The hash of the grammar's text."""
        return grammar_hash(self.source)

    @property
    def state_type(self) -> type[State]:
        """The class of its states."""
        return type(self.power_on)

    def state(self, **values: Any) -> State:
        """The state with these values; the other variables have the first word, or 0."""
        found = {name: spec.default for name, spec in self.variables.items()}
        return self.state_type.of({**found, **{n: plain(value) for n, value in values.items()}})

    @cached_property
    def by_id(self) -> Mapping[int, InstructionSpec]:
        """The instructions by their ID."""
        return {spec.id: spec for spec in self.instructions}

    @cached_property
    def by_name(self) -> Mapping[str, InstructionSpec]:
        """The instructions by their name."""
        return {spec.name: spec for spec in self.instructions}

    @cached_property
    def named_registers(self) -> Mapping[str, FieldSpec]:
        """The registers of all memories by their name."""
        return {one.name: one for cells in self.registers.values() for one in cells.values()}

    @cached_property
    def codes(self) -> Mapping[int, ResponseSpec]:
        """The responses by their code."""
        return {spec.code: spec for spec in self.responses}

    @cached_property
    def answers(self) -> Mapping[Outcome, ResponseSpec]:
        """The response for each outcome, NO_ANSWER where there is none."""
        found = {outcome: spec for spec in reversed(self.responses) for outcome in spec.outcomes}
        plain = PLAIN_ANSWER if self.reply.part("code") is None else NO_ANSWER
        return {**dict.fromkeys(Outcome, NO_ANSWER), Outcome.VALID: plain, **found}

    @cached_property
    def uncoded(self) -> frozenset[int]:
        """The keys of the instructions that get an answer without a code if they are valid."""
        return frozenset(
            self.key_of(spec.id)
            for spec in self.instructions
            if spec.answer is not None
            and (self.reply if spec.answer.fields else self.acknowledgement).part("code") is None
        )

    @cached_property
    def tells_changes(self) -> bool:
        """Whether the grammar says what instructions change; then others change nothing."""
        said = (s.changes is not None or s.writes or s.reads for s in self.instructions)
        return bool(self.variables) or any(said)

    @cached_property
    def plain(self) -> bool:
        """Whether a header byte tells ID and length, and one byte answers each frame.

        So it is in the protocol of the car and its family. Everything about frames then follows
        from the first byte, and no answer has data of its own.
        """
        layout, reply = self.layout, self.reply
        fields = [part for spec in self.instructions for part in spec.fields]
        return (
            (layout.head, layout.tail, reply.head) == (1, 0, 1)
            and sorted(part.role for part in layout.parts) == ["id", "length"]
            and all(part.width and not part.also for part in layout.parts)
            and reply.part("code") is not None
            and not (reply.has_data or self.errors or self.flags)
            and not any(part.many or part.names or part.flags or part.constant for part in fields)
        )

    @cached_property
    def headers(self) -> tuple[tuple[int, int], ...]:
        """The (ID, length) of each header byte; none where the header is not one byte."""
        identity, length = self.layout.part("id"), self.layout.part("length")
        if not (self.plain and identity and length):
            return ()
        frames = [bytes([byte]) for byte in range(256)]
        return tuple((identity.read(frame), length.read(frame)) for frame in frames)

    @cached_property
    def keys(self) -> tuple[int, ...]:
        """The ID of each `Judgement.key`; -1 where it stands for no ID.

        A key is the ID itself, as long as those of all instructions are below 255, or the place of
        the instruction. 255 stands for all others then.
        """
        used = [spec.id for spec in self.instructions[:255]]
        used = [*range(255)] if max(self.by_id, default=0) < 255 else used
        return (*used, *[-1] * (256 - len(used)))

    def key_of(self, identity: int | None) -> int:
        """The key of an ID; 255 for one without a key."""
        return self._key_of.get(identity, 255)

    @cached_property
    def _key_of(self) -> Mapping[int | None, int]:
        return {identity: key for key, identity in enumerate(self.keys) if identity >= 0}

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
        part = self.layout.part("id")
        return range(part.most + 1 if part else 1)

    @cached_property
    def data_lengths(self) -> range:
        """Every number of data bytes that a header can announce."""
        return range(max(self.lengths, default=_LONGEST_DATA) + 1)

    @cached_property
    def unused_ids(self) -> tuple[int, ...]:
        """The IDs that no instruction has."""
        return tuple(identity for identity in self.ids if identity not in self.by_id)

    @cached_property
    def longest_frame(self) -> int:
        """The length of the longest frame in bytes, its header included.

        Where nothing bounds it, that of the longest that is expected.
        """
        return self.layout.head + self.data_lengths[-1] + self.layout.tail

    @cached_property
    def limits(self) -> Mapping[str, tuple[int, int]]:
        """The smallest and largest value that instructions can give each state variable.

        A variable that they only reset to 0 has none.
        """
        found: dict[str, list[int]] = {}
        for spec in self.instructions:
            ranges = {f.name: (f.low, f.high) for f in spec.fields}
            for variable, value in spec.effect.assignments:
                if isinstance(value, From) and not value.words:
                    ends = [end * value.factor for end in ranges[value.field]]
                    found.setdefault(variable, []).extend(ends)
                elif isinstance(value, Changed):
                    found.setdefault(variable, []).extend((value.low, value.high))
                elif value and isinstance(value, int):
                    found.setdefault(variable, []).append(value)
        return {variable: (min(ends), max(ends)) for variable, ends in found.items()}

    def stops(self, effect: Effect) -> bool:
        """Whether an effect brings the device to rest, whatever its state was.

        A car stops by its motion; that its speed is 0 is a setting.
        """
        if self.wheels:
            return self.wheels.moment(effect) is Moment.STOP
        return self.at_rest is not None and self.at_rest.follows(effect.constants)

    def directed(self, state: State) -> bool:
        """Whether the device moves, or is a car that has a direction in which to move."""
        return self.wheels.drive(state).motion in self.wheels.turns if self.wheels else state.moving

    @property
    def car(self) -> Wheels:
        """What a car declares. Raises GrammarError for a device that is none."""
        if self.wheels is None:
            raise GrammarError(f"{self.name} declares no WHEELS")
        return self.wheels

    @cached_property
    def speeds(self) -> tuple[int, int]:
        """The smallest and largest speed that instructions give a car; 0 if none sets it."""
        return self.limits.get(self.car.speed, (0, 0))

    @cached_property
    def full_steering(self) -> int:
        """The greatest strength of steering to either side; 0 if no instruction steers."""
        return max(abs(end) for end in self.limits.get(self.car.steering, (0, 0)))

    @cached_property
    def settings(self) -> tuple[str, ...]:
        """The variables of a car but its kind of motion."""
        return tuple(name for name in self.variables if name != self.car.by)

    @cached_property
    def by_role(self) -> Mapping[str, str]:
        """A car's variables by what readings and faults call them: motion, speed, steering, led.

        The LED is the first of `lights`; the others have their own names.
        """
        car, lights = self.car, self.lights
        found = {"motion": car.by, "speed": car.speed, "steering": car.steering}
        return found | dict(zip(("led", *lights[1:]), lights, strict=False))

    @cached_property
    def role_of(self) -> Mapping[str, str]:
        """The inverse of `by_role`."""
        return {name: role for role, name in self.by_role.items()}

    def noun(self, variable: str) -> str:
        """A variable in a sentence: `LED` where the instruction of that name is written so."""
        capital = variable.upper()
        return capital if capital in self.by_name else variable

    @cached_property
    def lights(self) -> tuple[str, ...]:
        """The variables of a car that do not change how it drives."""
        return tuple(n for n in self.settings if n not in (self.car.speed, self.car.steering))

    @cached_property
    def stop_or_none(self) -> InstructionSpec | None:
        """The instruction without data that stops the device, None if there is none."""
        short = (spec for spec in self.instructions if not spec.length)
        return next((spec for spec in short if self.stops(spec.effect)), None)

    @cached_property
    def rest_requests(self) -> tuple[Request, ...]:
        """The fewest requests that bring the device to rest, whatever it did; none without AT_REST.

        An instruction that changes more than the state is not among them. Of equally few requests
        those come first that set the fewest other variables.
        """
        if self.stop_or_none is not None:
            return ((self.stop_or_none.name, {}),)
        wanted = self.at_rest.values if self.at_rest else {}
        setters = [spec for spec in self.instructions if not spec.changes and not spec.writes]
        setters.sort(key=lambda one: len(dict(one.effect.assignments).keys() - wanted))
        for right, requests in ways_on(frozenset(), [_towards(one, wanted) for one in setters]):
            if self.at_rest and self.at_rest.follows({name: wanted[name] for name in right}):
                return requests
        return ()

    @property
    def stop(self) -> InstructionSpec:
        """The instruction without data that stops the device; homing sends it.

        Raises GrammarError if the grammar has none.
        """
        if self.stop_or_none is None:
            raise GrammarError(f"no instruction without data stops the {self.device}")
        return self.stop_or_none

    @cached_property
    def pad_byte(self) -> int:
        """The header byte of `stop`, the only safe byte to pad with: read as a header, it stops."""
        return self.header_bytes[self.stop.id, 0]


def _towards(setter: InstructionSpec, wanted: Mapping[str, int | str]) -> Step[Request]:
    """The request of an instruction that sets what is wanted as far as its fields can.

    Beside it stand the variables that it sets so, and those that it sets otherwise. A field that
    sets none of them has its lowest value, and one of several values has none.
    """
    parts = {part.name: part for part in setter.fields if part.constant is None}
    fields: dict[str, Any] = {name: b"" if p.many else p.low for name, p in parts.items()}
    for variable, source in setter.effect.assignments:
        if variable in wanted and isinstance(source, From):
            number = source.number(wanted[variable])
            if number is not None and parts[source.field].in_range(number):
                fields[source.field] = number
    given = {name: new for name, new in assigned(setter.effect, fields) if name in wanted}
    sets = frozenset(name for name, new in given.items() if new == wanted[name])
    return (setter.name, fields), sets, frozenset(given) - sets


def require_family(protocol: Protocol, what: str) -> None:
    """Raise GrammarError, in one sentence, unless a protocol is of the robot car's family.

    `what` is what needs that. It has wheels too.
    """
    why = ""
    if not protocol.plain:
        why = f"one header byte and answers of one byte; {protocol.name} is laid out otherwise"
    elif protocol.wheels is None:
        why = f"wheels; {protocol.name} declares no WHEELS"
    if why:
        raise GrammarError(f"{what} is for the robot car and its family, which have {why}")


# A grammar imports its names from `bilprov.spec`, an older one from `spec`. Both are the same
# grammar: the hash is taken over the older spelling, so that older recordings still match.
_BARE = re.compile(r"^from spec\.", re.MULTILINE)
_ONE_PACKAGE = re.compile(r"^from bilprov\.spec\.", re.MULTILINE)


def grammar_hash(source: str) -> str:
    """The SHA-256, in hex, by which a grammar is known: texts that say the same have one."""
    found = hashlib.sha256(_ONE_PACKAGE.sub("from spec.", source).encode()).hexdigest()
    return _FIRST if found in _SAME_AS_FIRST else found


def load(source: str, origin: str = "grammar") -> Protocol:
    """Read a grammar's text into a Protocol.

    `origin` is the file's name, used in messages. Raises GrammarError, in one sentence, for text
    that does not run or does not declare what a grammar must.
    """
    origin = one_line(origin, _LONGEST)
    space: dict[str, Any] = {"__name__": "grammar", "__file__": origin}
    unusable = f"the grammar {origin} cannot be used: "
    try:
        with warnings.catch_warnings():  # Python's remarks about the text are not ours to print
            warnings.simplefilter("ignore")
            tree = ast.parse(_BARE.sub("from bilprov.spec.", source), origin)
            # dont_inherit: a grammar does not inherit this file's __future__ imports.
            code = compile(tree, origin, "exec", dont_inherit=True)
        exec(code, space)
    except (Exception, SystemExit) as error:
        what: object = error
        where = _line(error, origin)
        if isinstance(error, WrongValue):
            raise GrammarError(f"{unusable}{error}{where}") from error
        if isinstance(error, SyntaxError):
            what, where = error.msg, f" (line {error.lineno})"
        if isinstance(error, ImportError):
            what = error.msg.partition(" (")[0]  # without the path of the module's file
        raise GrammarError(
            f"the grammar {origin} does not load: {type(error).__name__}: "
            f"{_words(what)}{where}; start from what `bilprov spec emit grammar` writes"
        ) from error
    try:
        _require_each_id_once(tree)
        _require_no_slip(tree, space)
        return _read(_declarations(space), source, origin)
    except UserError as error:
        raise GrammarError(f"{unusable}{error}{_declared_in(source, str(error))}") from None
    except Exception as error:  # construct raises many kinds for declarations that make no sense
        raise GrammarError(
            f"{unusable}{_words(error)}; compare it with what `bilprov spec emit grammar` writes"
        ) from error


def _words(why: object) -> str:
    """Why a text is no grammar, in words; Python's own for a long number are about its settings."""
    words = one_line(why, _LONGEST)
    return "a number has too many digits" if "integer string conversion" in words else words


def _line(error: BaseException, origin: str) -> str:
    """Where in the grammar an error comes from, in words; none if that is not known."""
    trace, line = error.__traceback__, 0
    while trace:
        if trace.tb_frame.f_code.co_filename == origin:
            line = trace.tb_lineno
        trace = trace.tb_next
    return f" (line {line})" if line else ""


def _declared_in(source: str, message: str) -> str:
    """Where the declaration stands that a message names, in words; none if that is not known.

    A message names a declaration by itself (`FRAME`), a part of it (`FRAME.crc`, `Speed.speed`), or
    has its text in quotes.
    """
    lines = [*enumerate(source.splitlines(), 1)]
    named = re.findall(r"\w+(?:\.\w+)+|\b[A-Z][A-Z_]{2,}\b", message)
    quoted = re.findall("'([^']+)'", message)
    for names in (*([one] for one in quoted), *(word.split(".") for word in named)):
        line = 0
        for name in map(re.escape, names):
            declared = re.compile(rf"^([\w, ]+, )?{name}\b[\w, ]*=|[\"']{name}[\"']|\b{name}=")
            found = (at for at, text in lines if at >= line and declared.search(text))
            line = next(found, line)
        if line:
            return f" (line {line})"
    return ""


def _require_no_slip(tree: ast.Module, space: dict[str, Any]) -> None:
    """Raise GrammarError for a name that nothing uses and that is meant as another one.

    An AT_REST under another name would be lost, and with it what stops the device.
    """
    known = _Grammar.__struct_fields__
    names = [node for node in ast.walk(tree) if isinstance(node, ast.Name)]
    used = {*known, *(node.id for node in names if isinstance(node.ctx, ast.Load))}
    for name in (node.id for node in names if node.id not in used):
        from difflib import get_close_matches  # a few milliseconds, for few grammars

        near = [word for word, kind in _KINDS.items() if isinstance(space.get(name), kind)]
        near = near or get_close_matches(name.upper(), known, 1, _NEAR)
        if near:
            raise GrammarError(f"nothing uses '{name}'; did you mean {near[0]}?")


def _require_each_id_once(tree: ast.Module) -> None:
    """Raise GrammarError for a number that stands twice: Python silently drops one of them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Dict):
            keys = [key.value for key in node.keys if isinstance(key, ast.Constant)]
            twice = next((key for key, count in Counter(keys).items() if count > 1), None)
            if twice is not None:
                raise GrammarError(
                    f"the number {shown(twice)} stands twice in line {node.lineno} and on"
                )


def _declarations(space: dict[str, Any]) -> _Grammar:
    """What a grammar declares, each of the kind that it must be."""
    fields = {field.name: field for field in msgspec.structs.fields(_Grammar)}
    for name, field in fields.items():
        if field.required and name not in space:
            raise GrammarError(f"it declares no {name}")
        if name in space:
            require(name, space[name], field.type)
    return _Grammar(**{name: space[name] for name in fields if name in space})


def _read(declared: _Grammar, source: str, origin: str) -> Protocol:
    layout, data = read_layout("FRAME", declared.FRAME)
    data = unwrapped(data.subcon) if isinstance(data, FixedSized) else data
    if not isinstance(data, Switch) or data.cases is not declared.INSTRUCTIONS:
        raise GrammarError('FRAME must have "data" / Switch(this.id, INSTRUCTIONS)')
    reply, acknowledgement, errors = _replies(declared, layout.covered)
    specs = [_instruction(declared, one, layout, reply) for one in sorted(declared.INSTRUCTIONS)]
    _require_each_name_once("two instructions are named", (spec.name for spec in specs))
    if unknown := layout.unchecked - {spec.id for spec in specs}:
        raise GrammarError(
            f"FRAME has no check for the ID {min(unknown)}, which no instruction has; allowed are "
            f"{', '.join(str(spec.id) for spec in specs)}"
        )
    asked = {*layout.told, *(name for spec in specs for name in spec.numbers)}
    _require_repeated("FRAME", layout, set())
    for what, one in (("REPLY", reply), ("ACK", acknowledgement), *(("ERROR", e) for e in errors)):
        _require_repeated(what, one, asked)
    every: list[tuple[str, Sets, InstructionSpec | None]] = [
        (f"{spec.name}.effect", unwrapped(declared.INSTRUCTIONS[spec.id]).effect, spec)
        for spec in specs
    ]
    every += [(name, getattr(declared, name) or Sets(), None) for name in ("FAULTY", "POWER_ON")]
    if not (declared.STATE or declared.REPLY) and any(sets.values for _, sets, _ in every):
        declared = replace(  # grammars could not declare the state at first: it was the car's
            declared,
            **{name: getattr(declared, name) or getattr(grammar, name) for name in _OF_A_CAR},
        )
    for name in ("FAULTY", "POWER_ON") if declared.WHEELS else ():
        if getattr(declared, name) is None:
            raise GrammarError(f"it declares no {name}")
    variables = _variables(declared, every)
    *effects, on_fault, at_power_on = (_effect(variables, *one) for one in every)
    instructions = tuple(
        replace(
            spec,
            effect=effect,
            writes=next((one for one in declared.MEMORY if _uses(spec, one, "writes")), None),
            reads=next((one for one in declared.MEMORY if _uses(spec, one, "reads")), None),
        )
        for spec, effect in zip(specs, effects, strict=True)
    )
    _require_reported(instructions, variables)
    _require_memory(instructions, declared.MEMORY)
    responses = tuple(
        ResponseSpec(code, answer.name, answer.document, answer.prose, answer.outcomes)
        for code, answer in sorted(declared.RESPONSE.answers.items() if declared.RESPONSE else ())
    )
    _require_each_name_once("two responses are named", (spec.name for spec in responses))
    _require_codes(instructions, responses)
    _require_rest_and_wheels(declared, variables)
    made = state_class(variables.values(), declared.AT_REST, declared.WHEELS)
    first = made.of({name: spec.default for name, spec in variables.items()})
    protocol = Protocol(
        source=source,
        origin=origin,
        name=declared.NAME,
        version=declared.VERSION,
        document=declared.DOCUMENT,
        instructions=instructions,
        responses=responses,
        layout=layout,
        reply=reply,
        acknowledgement=acknowledgement,
        errors=errors,
        flags=bool(declared.RESPONSE and declared.RESPONSE.flags),
        device=declared.DEVICE or "device",
        registers=_registers(declared.REGISTERS, instructions),
        variables=variables,
        at_rest=declared.AT_REST,
        wheels=made.wheels,
        on_fault=on_fault,
        power_on=at_power_on.apply(first),
        timing=declared.TIMING,
        line=declared.LINE,
        clauses=declared.CLAUSES,
    )
    _require_each_outcome(declared, protocol)
    _require_stops(protocol)
    return protocol


def _require_stops(protocol: Protocol) -> None:
    """Raise GrammarError where nothing stops the device, or a car runs at power-on."""
    device, wheels, at_rest = protocol.device, protocol.wheels, protocol.at_rest
    if at_rest and not wheels and not protocol.rest_requests:
        wanted = ", ".join(f"{name}={value}" for name, value in at_rest.values.items())
        raise GrammarError(
            f"AT_REST is {type(at_rest).__name__}({wanted}), and no requests reach that; give an "
            "instruction with an effect that does, or leave AT_REST out"
        )
    if not wheels:
        return
    if protocol.stop_or_none is None:
        raise GrammarError(
            f"no instruction without data stops the {device}; the kit needs one to home"
        )
    if not protocol.stops(protocol.on_fault):
        raise GrammarError(
            f"FAULTY does not set {wheels.by} to {wheels.still}; a faulty instruction must stop "
            f"the {device}"
        )
    at_first = getattr(protocol.power_on, wheels.by)
    if at_first in wheels.turns:
        raise GrammarError(
            f"POWER_ON sets {wheels.by} to {at_first}; a {device} must stand still at power-on"
        )


def _variables(
    declared: _Grammar, every: Iterable[tuple[str, Sets, InstructionSpec | None]]
) -> dict[str, VariableSpec]:
    """The variables by name.

    A grammar that does not declare its state sets the car's, to any numbers.
    """
    state = declared.STATE or (grammar.STATE if declared.WHEELS else Variables())
    found = dict(state.specs)
    for where, sets, of in every:
        ranges = {part.name: (part.low, part.high) for part in of.fields} if of else {}
        for name, value in sets.values.items():
            if name not in found:
                raise GrammarError(
                    f"{where} sets {name}, allowed are "
                    f"{', '.join(found) or 'none, since STATE declares none'}"
                )
            spec, ends = found[name], [value] if type(value) is int else []
            if isinstance(value, From):
                ends = [end * value.factor for end in ranges.get(value.field, ())]
            if isinstance(value, Unknown):
                found[name] = replace(spec, unknown=True)
            elif ends and not (declared.STATE or spec.words):
                found[name] = replace(spec, low=min(spec.low, *ends), high=max(spec.high, *ends))
    return found


def _require_variable(
    where: str, names: Iterable[str], variables: Mapping[str, VariableSpec]
) -> None:
    for name in names:
        if name not in variables:
            raise GrammarError(
                f"{where} names the variable {shown(name)}, allowed are {', '.join(variables)}"
            )


def _require_reported(
    instructions: Iterable[InstructionSpec], variables: Mapping[str, VariableSpec]
) -> None:
    """Raise GrammarError for a field that cannot tell the variable that it reports."""
    for spec in instructions:
        for part in spec.fields:
            if part.reports:
                raise GrammarError(f"{spec.name}.{part.name} has a Reports: only answers report")
        for part in spec.answer.fields if spec.answer else ():
            if part.reports is None:
                continue
            where = f"the answer of {spec.name}.{part.name}"
            _require_variable(where, [part.reports.variable], variables)
            told = variables[part.reports.variable]
            for value in told.words or (told.low, told.high):
                reported = part.reports.value(value, part.names)
                if reported is None or not part.in_range(reported):
                    raise GrammarError(
                        f"{where} reports {told.name}, and cannot hold its value {value}"
                    )


def _require_rest_and_wheels(declared: _Grammar, variables: Mapping[str, VariableSpec]) -> None:
    """Raise GrammarError where AT_REST or WHEELS name what STATE does not have."""
    at_rest, wheels = declared.AT_REST, declared.WHEELS
    wanted = at_rest.values if at_rest else {}
    _require_variable("AT_REST", wanted, variables)
    for name, value in wanted.items():
        if not variables[name].holds(value):
            raise GrammarError(
                f"AT_REST names {name}={shown(value)}, allowed is {variables[name].allowed}"
            )
    if wheels is None:
        return
    _require_variable("WHEELS", (wheels.by, wheels.speed, wheels.steering), variables)
    if not {*wheels.turns} < {*variables[wheels.by].words}:
        raise GrammarError(
            f"WHEELS turns by {', '.join(wheels.turns)}; allowed are words of {wheels.by}, and "
            "one of them must be left out, in which the wheels stand still"
        )
    if at_rest is None:
        raise GrammarError("it declares WHEELS and no AT_REST")
    taken = {"t", "left", "right", "wheels", "curve", "answer", "motion"} - {wheels.by}
    for name in taken & {*variables}:
        raise GrammarError(f"STATE has the variable {name}, which a probe reports for every car")


_OF_A_CAR = ("AT_REST", "WHEELS", "DEVICE")


def _require_each_name_once(what: str, names: Iterable[str]) -> None:
    """Raise GrammarError for a name that stands twice in any case: users may write any."""
    by_name: dict[str, str] = {}
    for name in names:
        if name.lower() in by_name:
            raise GrammarError(f"{what} {by_name[name.lower()]}")
        by_name[name.lower()] = name


def _replies(
    declared: _Grammar, covered: tuple[str, ...]
) -> tuple[Layout, Layout, tuple[Layout, ...]]:
    """The layouts of an answer, of one without data, and of errors."""
    if declared.REPLY is None:
        reply, _ = read_layout("RESPONSE", declared.RESPONSE or Struct("data" / Data()))
        if declared.RESPONSE and reply.head != 1:
            raise GrammarError("RESPONSE must be one byte")
        return reply, reply, ()
    reply, _ = read_layout("REPLY", declared.REPLY, covered)
    acknowledgement, _ = read_layout("ACK", declared.ACK or declared.REPLY, covered)
    several = declared.ERROR if isinstance(declared.ERROR, tuple) else (declared.ERROR,)
    errors = tuple(read_layout("ERROR", one, covered)[0] for one in several)
    return reply, reply if acknowledgement == reply else acknowledgement, errors


def _require_repeated(what: str, layout: Layout, asked: set[str]) -> None:
    """Raise GrammarError for a Same of what no request has."""
    for part in layout.parts:
        if part.same and part.same not in asked:
            allowed = ", ".join(sorted(asked)) or "none, since it answers nothing"
            raise GrammarError(f"{what}.{part.name} is Same({part.same!r}), allowed are {allowed}")


def _require_each_outcome(declared: _Grammar, protocol: Protocol) -> None:
    """Raise GrammarError unless each outcome that a frame can have is answered, or is in SILENT."""
    layout, fields = protocol.layout, [f for spec in protocol.instructions for f in spec.fields]
    possible = {
        Outcome.VALID: declared.REPLY is None,
        Outcome.UNKNOWN_ID: True,
        Outcome.BAD_DATA: not all(part.unlimited for part in fields),
        Outcome.TOO_MANY: layout.part("length"),
        Outcome.TOO_FEW: layout.part("length"),
        Outcome.BAD_CHECKSUM: layout.check,
        Outcome.BAD_SYNC: any(part.offset < 0 for part in layout.constants),
    }
    answered = [outcome for spec in protocol.responses for outcome in spec.outcomes]
    silent = declared.SILENT if declared.REPLY else ()
    twice = [outcome.value for outcome in silent if outcome in answered]
    if twice:
        raise GrammarError(f"{twice[0]} stands in RESPONSE and in SILENT, allowed is one of them")
    met = {*answered, *silent}
    missing = [outcome for outcome, can_be in possible.items() if can_be and outcome not in met]
    if missing and (declared.REPLY or declared.RESPONSE):
        told = ", ".join(f"Outcome.{one.name}" for one in missing)
        where = f"; give it an Answer in RESPONSE, or put {told} into SILENT"
        raise GrammarError(
            f"no response stands for {', '.join(one.value for one in missing)}"
            f"{where if declared.REPLY else ''}"
        )
    if not declared.REPLY:
        _require_each_name_once("two responses stand for", (one.value for one in answered))


def _require_codes(
    instructions: tuple[InstructionSpec, ...], responses: tuple[ResponseSpec, ...]
) -> None:
    """Raise GrammarError for a field or a memory whose code is the name of no Answer."""
    names = ["", *(spec.name for spec in responses)]
    for spec in instructions:
        codes = [(f"{spec.name}.{part.name}", part.code) for part in spec.fields]
        codes += [(f"the Memory that {spec.name} writes", spec.writes.code)] if spec.writes else []
        for where, code in codes:
            if code not in names:
                raise GrammarError(
                    f"{where} has code={shown(code)}, allowed are names of an Answer: "
                    f"{', '.join(names[1:]) or 'there is none'}"
                )


def _instruction(
    declared: _Grammar, identity: int, layout: Layout, reply: Layout
) -> InstructionSpec:
    """Read an instruction; its effect and its memory are still open."""
    declaration = declared.INSTRUCTIONS[identity]
    body, name, prose = unwrapped(declaration), declaration.name, prose_of(declaration)
    part = layout.part("id")
    if part is None:
        raise GrammarError("FRAME has no part named id, by which a frame names its instruction")
    if not 0 <= identity <= part.most:
        raise GrammarError(
            f"the header cannot carry the ID {identity} of {shown(name)}, allowed are 0 to "
            f"{part.most}"
        )
    if not isinstance(body, Instruction) or not name:
        raise GrammarError(
            f'instruction {identity} of INSTRUCTIONS must be written "Name" / Instruction(...)'
        )
    require_word(f"the name of instruction {identity}", name)
    require(f"the prose of {name}", prose, str)
    announced = layout.part("length")
    data = read_data(name, body.subcons, framed=announced is not None)
    if announced and data.length > announced.most:
        raise GrammarError(
            f"{name} has {data.length} data bytes; a header announces at most {announced.most}"
        )
    if announced and data.length < -announced.also and not announced.number.signed:
        raise GrammarError(
            f"{name} has {data.length} data bytes; a header announces at least {-announced.also}"
        )
    for shared in {part.name for part in layout.parts} & {part.name for part in data.fields} - {""}:
        raise GrammarError(f"{name}.{shared} has the name of a part of FRAME; give it another")
    answer = None
    if body.answer is not None:
        if not (declared.REPLY or declared.RESPONSE):
            raise GrammarError(
                "it declares no REPLY and no RESPONSE; declare how answers look, or give each "
                "Instruction answer=None"
            )
        members = body.answer.subcons if isinstance(body.answer, Struct) else [body.answer]
        if members and not reply.has_data:
            raise GrammarError(f"the answer of {name} has data; REPLY has no part Data()")
        framed, asked = reply.part("length") is not None, [*layout.told, *data.numbers]
        answer = read_data(f"the answer of {name}", members, framed=framed, asked=asked)
    return InstructionSpec(
        id=identity,
        name=name,
        document=body.document,
        prose=prose,
        fields=data.fields,
        length=data.length,
        effect=Effect(),
        answer=answer,
        changes=body.changes,
    )


def _require_memory(
    instructions: tuple[InstructionSpec, ...], declared: tuple[Memory, ...]
) -> None:
    """Raise GrammarError for a memory that no instruction uses, or that is not as it says."""
    names = {"", *(spec.name for spec in instructions)}
    for memory in declared:
        if not any(memory in (spec.writes, spec.reads) for spec in instructions):
            raise GrammarError(
                f"MEMORY has {memory.name} at {memory.at}, and no instruction writes or reads "
                f"{memory.value} there"
            )
        for word, name in (("until", memory.until), ("reset", memory.reset)):
            if name not in names:
                raise GrammarError(
                    f"MEMORY has {memory.name} {word} {name}, and there is no such instruction"
                )
    for spec in instructions:
        many = {part.name: part.many for part in spec.fields}
        for one in filter(None, (spec.writes, spec.reads)):
            # A place may be bytes, the beginning of which is the first cell.
            at = many.get(one.at)
            wrong = [one.at] if at and at.element else []
            wrong += [name for name in (one.count, one.keep) if many.get(name)]
            if wrong:
                raise GrammarError(
                    f"MEMORY has {one.name} by {spec.name}.{wrong[0]}, allowed is one number"
                )
            if one is spec.writes and not many[one.value] and (one.blocks or one.count in many):
                raise GrammarError(
                    f"MEMORY has {one.name} with a count, and {spec.name}.{one.value} is one "
                    "number; leave the count out"
                )


def _registers(
    declared: Mapping[str, Mapping[int, Construct]], instructions: tuple[InstructionSpec, ...]
) -> Mapping[str, Mapping[int, FieldSpec]]:
    """The named cells of each memory by their place."""
    used = [one for spec in instructions for one in (spec.writes, spec.reads) if one]
    memories = {one.name for one in used if not (one.bits or one.latest)}
    found: dict[str, dict[int, FieldSpec]] = {}
    for memory, cells in declared.items():
        if memory not in memories:
            raise GrammarError(
                f"REGISTERS has {shown(memory)}, allowed are memories whose cells are numbers at a "
                f"place that each request has: {', '.join(sorted(memories)) or 'there is none'}"
            )
        found[memory] = {place: read_register(memory, cells[place]) for place in sorted(cells)}
        _require_in_cells(memory, found[memory], instructions)
    data = [one for spec in instructions for one in (spec, spec.answer) if one]
    fields = {part.name.lower() for one in data for part in one.fields}
    names = (one.name for cells in found.values() for one in cells.values())
    _require_each_name_once(
        "two registers, or a field and a register, are named", (*fields, *names)
    )
    return found


def _require_in_cells(
    name: str, registers: Mapping[int, FieldSpec], instructions: tuple[InstructionSpec, ...]
) -> None:
    """Require that registers are whole cells of a memory, at places that requests can have."""
    used: list[tuple[InstructionSpec, Memory | None, DataSpec | None]] = []
    for spec in instructions:
        used += [(spec, spec.writes, spec), (spec, spec.reads, spec.answer)]
    for spec, memory, data in used:
        if memory is None or data is None or memory.name != name:
            continue
        _, width = cells_in(memory, data)
        at = next((part for part in spec.fields if part.name == memory.at and part.number), None)
        for place, one in registers.items():
            if one.size % width:
                raise GrammarError(
                    f"REGISTERS has {one.name} of size {one.size} in {name}, allowed are "
                    f"multiples of {width}, the size of a cell of {spec.name}"
                )
            if at and place > at.high * memory.factor:
                raise GrammarError(
                    f"REGISTERS has {one.name} at {place} in {name}, allowed are places up to "
                    f"{at.high * memory.factor}, the highest that {spec.name} can ask for"
                )


def cells_in(memory: Memory, data: DataSpec) -> tuple[FieldSpec, int]:
    """The field with the cells of a memory in some data, and the bytes of one cell."""
    part = next(one for one in data.fields if one.name == memory.value)
    return part, part.many.width if part.many else part.size


def _uses(spec: InstructionSpec, memory: Memory, how: str) -> bool:
    """Whether an instruction "writes" a memory, or "reads" it: its answer tells what is in it.

    An answer that repeats what was just written tells nothing.
    """
    needed = {memory.of, "" if memory.latest else memory.at}
    held = memory.value in spec.names
    if how == "reads":
        told = spec.answer.fields if spec.answer else ()
        held = memory.value in [part.name for part in told] and (memory.only == how or not held)
        needed.add(memory.count)
    named = not memory.by or spec.name in memory.by
    return held and named and memory.only in ("", how) and needed - {""} <= spec.names


def _effect(
    variables: Mapping[str, VariableSpec], where: str, sets: Sets, of: InstructionSpec | None
) -> Effect:
    """The effect of an instruction. Raises GrammarError for one that STATE does not allow.

    `where` is what declares it.
    """
    fields = {part.name: part for part in (of.fields if of else ()) if part.number}
    assignments: list[tuple[str, Source]] = []
    for name, value in sets.values.items():
        spec, wrong = variables[name], ""
        source: Any = plain(value)
        if isinstance(value, From):
            part = fields.get(value.field)
            if part is None:
                raise GrammarError(
                    f"{where} names the field {value.field}, which is not there as one number"
                )
            words = tuple(word for word, _ in part.names)
            low, high = sorted((part.low * value.factor, part.high * value.factor))
            if not spec.words and not spec.low <= low <= high <= spec.high:
                wrong = f"{low} to {high}"
            elif spec.words and not (words and {*words} <= {*spec.words}):
                wrong = ", ".join(words) or "a number"
            source = replace(value, words=part.names if spec.words else ())
        elif isinstance(value, Changed):
            wrong = "a number" if spec.words else ""
            source = replace(value, low=spec.low, high=spec.high)
        elif isinstance(value, Unknown):
            source = None
        elif value is None or not spec.holds(value):
            wrong = shown(value)
        if wrong:
            raise GrammarError(f"{where} sets {name} to {wrong}, allowed is {spec.allowed}")
        assignments.append((name, source))
    return Effect(tuple(assignments))
