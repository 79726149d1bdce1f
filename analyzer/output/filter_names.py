"""The names and words of filter expressions, with the functions that read them from JSON lines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, get_args

from bilprov.analyzer.output.json_lines import JsonLine
from bilprov.captures.schemas import Direction, FrameKind
from bilprov.spec.motion import VARIABLES, Motion
from bilprov.spec.protocol import Protocol


class _Missing:
    """The type of MISSING, a value that a line does not have: no comparison with it holds."""


MISSING = _Missing()

HELP = """\
Show only the lines for which EXPR holds, like "faulty or latency > 0.05" or "direction == host
and state.speed > 100". It knows and, or, not, ==, !=, <, <=, >, >=, in, parentheses, numbers
(0x1f too) and 'text'; the keys of the JSON lines (direction, kind, name, hex, judgement, reason,
latency, t, sequence, answers, agrees, faults), state.motion, state.speed and so on, faulty, and
every field of an instruction by its name. Names of instructions, responses, kinds and motions
need no quotes. A comparison with something that a line does not have is false."""


class Name(NamedTuple):
    """A name's kind of value (`text`, `number`, `truth`, `list of text`), and its getter."""

    kind: str
    get: Callable[[JsonLine], Any]


def _of(kind: str, key: str) -> Name:
    def get(line: JsonLine) -> Any:
        value = getattr(line, key)
        return MISSING if value is None else value

    return Name(kind, get)


def _field(name: str) -> Name:
    return Name("number", lambda line: line.fields.get(name, MISSING))


def _state(variable: str) -> Name:
    kind = {"motion": "text", "moving": "truth"}.get(variable, "number")
    return Name(kind, lambda line: getattr(line.state, variable))


KEYS = {
    **{key: _of("text", key) for key in ("direction", "kind", "name", "hex")},
    **{key: _of("text", key) for key in ("judgement", "reason")},
    **{key: _of("number", key) for key in ("latency", "t", "sequence", "answers")},
    "agrees": _of("truth", "agrees"),
    "faults": _of("list of text", "faults"),
    "faulty": Name("truth", lambda line: bool(line.faults)),
    **{f"state.{variable}": _state(variable) for variable in (*VARIABLES, "moving")},
}


def names(protocol: Protocol) -> Mapping[str, Name]:
    """All names of a filter. A field with the same name as a key is reached as `fields.NAME`."""
    fields = {
        part.name: _field(part.name) for spec in protocol.instructions for part in spec.fields
    }
    return {**fields, **KEYS, **{f"fields.{name}": get for name, get in fields.items()}}


def words(protocol: Protocol) -> tuple[str, ...]:
    """The texts that need no quotes; a name takes precedence over a word of the same spelling."""
    return tuple(
        dict.fromkeys(
            [
                *(spec.name for spec in protocol.instructions),
                *(spec.name for spec in protocol.responses),
                *(kind for kind in (*get_args(FrameKind), "fault")),
                *get_args(Direction),
                *(motion.value for motion in Motion),
            ]
        )
    )
