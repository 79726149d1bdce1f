"""What instructions and their fields are called in Python: `RotateLeft` is `rotate_left`."""

from __future__ import annotations

import keyword
import unicodedata
from collections.abc import Collection, Iterable, Mapping
from typing import TypeVar

from spec.protocol import FieldSpec, InstructionSpec, Protocol

T = TypeVar("T")

RESERVED = frozenset({"close", "home", "look", "protocol", "sees", "send", "send_bytes", "wait"})
"""What a client of a robot has besides the instructions; an instruction `Home` is `home_` there."""


def method_names(protocol: Protocol) -> Mapping[str, InstructionSpec]:
    """Each instruction by the name of its method, in the order of the IDs."""
    words = ((snake_case(spec.name, "do_"), spec) for spec in protocol.instructions)
    return _each_once(words, RESERVED)


def parameter_names(spec: InstructionSpec) -> Mapping[str, FieldSpec]:
    """Each field by the name of its parameter, in the order in which they are sent."""
    words = ((snake_case(part.name, "field_"), part) for part in spec.fields)
    return _each_once(words, frozenset({"self"}))


def snake_case(name: str, prefix: str) -> str:
    """A name as Python writes it, small and with underscores: `LEDOn` is `led_on`.

    What no identifier may have is an underscore too; `prefix` goes before a name that begins with
    no letter.
    """
    name = unicodedata.normalize("NFKC", name)
    word = ""
    for at, char in enumerate(name):
        before, after = name[at - 1 : at], name[at + 1 : at + 2]
        if char.isupper() and (not before.isupper() or after.islower()) and before.isalnum():
            word += "_"
        word += char if f"a{char}".isidentifier() else "_"
    # Python reads identifiers in this form: another one could not be called by what one types.
    word = unicodedata.normalize("NFKC", word.lower())
    return word if word[:1].isalpha() else prefix + word.strip("_")


def _each_once(words: Iterable[tuple[str, T]], reserved: Collection[str]) -> Mapping[str, T]:
    """The words as keys; one that is taken gets an underscore, as Python's style guide has it."""
    taken: dict[str, T] = {}
    for word, value in words:
        while keyword.iskeyword(word) or word in reserved or word in taken:
            word += "_"
        taken[word] = value
    return taken
