"""Names of instructions and their fields in Python: `RotateLeft` is `rotate_left`."""

from __future__ import annotations

import keyword
import unicodedata
from collections.abc import Collection, Iterable, Mapping
from typing import TypeVar

from bilprov.spec.data import DataSpec, FieldSpec
from bilprov.spec.protocol import InstructionSpec, Protocol

T = TypeVar("T")

RESERVED = frozenset({"close", "home", "look", "protocol", "sees", "send", "send_bytes", "wait"})
"""Method names that a robot client has itself; an instruction `Home` becomes `home_`."""


def method_names(protocol: Protocol) -> Mapping[str, InstructionSpec]:
    """Return each instruction by the name of its method, in the order of the IDs."""
    words = ((snake_case(spec.name, "do_"), spec) for spec in protocol.instructions)
    return each_once(words, RESERVED.union(keyword.kwlist))


def parameter_names(spec: InstructionSpec) -> Mapping[str, FieldSpec]:
    """Return each field by the name of its parameter, in the order in which they are sent."""
    words = (
        (snake_case(part.name, "field_"), part) for part in spec.fields if part.constant is None
    )
    return each_once(words, {"self", *keyword.kwlist})


def answer_names(data: DataSpec) -> Mapping[str, FieldSpec]:
    """Return each field of an answer by its name in a named tuple, whose own methods have others.

    Fields without a value of their own are left out.
    """
    words = ((snake_case(part.name, "field_"), part) for part in data.fields if not part.constant)
    return each_once(words, {"count", "index", *keyword.kwlist})


def taken_type(part: FieldSpec) -> str:
    """The type of the values that a field's parameter takes."""
    number = "int | str" if part.names else "int"
    if part.many is None:
        return number
    return "bytes | str" if part.many.element is None else f"Sequence[{number}]"


def told_type(part: FieldSpec) -> str:
    """The type of the value that a field of an answer has."""
    if part.many is None:
        return taken_type(part)
    number = "int | str" if part.names else "int"
    return "bytes" if part.many.element is None else f"tuple[{number}, ...]"


def read_by_name(protocol: Protocol, spec: InstructionSpec) -> tuple[str, str]:
    """The field that takes the name of a register, and the last one, which is left out then.

    Both are "" for an instruction that does not read registers with names.
    """
    memory = spec.reads
    if memory is None or spec.writes or memory.name not in protocol.registers:
        return "", ""
    return memory.at, memory.count if spec.fields[-1].name == memory.count else ""


def snake_case(name: str, prefix: str) -> str:
    """Return a name in lower case with underscores: `LEDOn` is `led_on`.

    Characters that no identifier may have become underscores; `prefix` goes before a name that
    does not begin with a letter.
    """
    name = unicodedata.normalize("NFKC", name)
    word = ""
    for at, char in enumerate(name):
        before, after = name[at - 1 : at], name[at + 1 : at + 2]
        if char.isupper() and (not before.isupper() or after.islower()) and before.isalnum():
            word += "_"
        word += char if f"a{char}".isidentifier() else "_"
    # Python normalises identifiers to NFKC: a name in another form could not be called.
    word = unicodedata.normalize("NFKC", word.lower())
    return word if word[:1].isalpha() else prefix + word.strip("_")


def each_once(words: Iterable[tuple[str, T]], reserved: Collection[str]) -> Mapping[str, T]:
    """Return the values by their words; a word that is taken or reserved gets an underscore."""
    taken: dict[str, T] = {}
    for word, value in words:
        while word in reserved or word in taken:
            word += "_"
        taken[word] = value
    return taken
