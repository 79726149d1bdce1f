"""Errors whose text is one sentence for the user, and the checks of what a grammar declares.

Whatever a grammar says may reach a terminal, a file name or a header of C. So its texts are short
and hold only characters that print: nothing that shows them has to make them safe.
"""

from __future__ import annotations

import re
import reprlib
from collections.abc import Callable, Mapping
from functools import cache, wraps
from inspect import Parameter, signature
from typing import Any, ParamSpec, TypeVar, get_args, get_type_hints

import msgspec

LONGEST_SENTENCE = 4000


def one_line(text: object, most: int = LONGEST_SENTENCE) -> str:
    """Foreign text as one line of at most `most` characters, all of which print.

    What does not print becomes an escape like `\\x1b`. Of a longer text the middle is left out: in
    a sentence what came stands first, what to do last.
    """
    line = str(text)
    if len(line) > 4 * most:
        line = line[: 2 * most] + line[-2 * most :]
    line = " ".join(line.split())
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    half = most // 2
    return line if len(line) <= most else f"{line[:half]} … {line[half + 3 - most :]}"


class UserError(Exception):
    """Wrong input, or something unusable; the text says what came, what is allowed, what to do.

    Whatever foreign text is in it, it is one line that a terminal can show.
    """

    def __init__(self, sentence: object = "") -> None:
        super().__init__(one_line(sentence))


LONGEST_NAME = 64
LONGEST_TEXT = 1000
LARGEST = 1 << 128
"""The bound of the numbers in a grammar."""

# What msgspec calls a kind of values, and what a grammar's author does.
_KINDS = {
    "str": "a text",
    "int": "a whole number",
    "float": "a number",
    "bool": "True or False",
    "array": "a tuple",
    "object": "a dict",
}

P = ParamSpec("P")
T = TypeVar("T")


class WrongValue(UserError):
    """Raised for a declared value of a wrong type or size; the text says what is allowed."""


def shown(value: object) -> str:
    """A value in a few characters, all of which print."""
    return one_line(reprlib.repr(value), LONGEST_NAME)


def require(what: str, value: Any, allowed: Any) -> None:
    """Raise WrongValue unless the value is of a type, texts are short and print, numbers small.

    The type may have bounds: `Annotated[int, Meta(ge=0)]`.
    """
    try:
        msgspec.convert(value, allowed)
    except msgspec.ValidationError as error:
        expected = re.sub(r", got.*| - at.*", "", str(error))
        kind, bounds = re.sub(r"^Expected|^Invalid.*|`", "", expected).strip().partition(" ")[::2]
        words = _KINDS.get(kind, f"a {kind}") if kind else ", ".join(map(str, get_args(allowed)))
        if kind == "object" and isinstance(allowed, type):
            words = f"a {allowed.__name__}"
        within = " within it" if " - at " in str(error) else ""
        sentence = f"{what} is {shown(value)}, allowed{within} is {words} {bounds}"
        raise WrongValue(sentence.strip()) from error
    if isinstance(value, str):
        if len(value) > LONGEST_TEXT:
            raise WrongValue(f"{what} has {len(value)} characters, allowed are {LONGEST_TEXT}")
        unseen = next((character for character in value if not character.isprintable()), "")
        if unseen:
            raise WrongValue(
                f"{what} holds the character U+{ord(unseen):04X}, allowed are characters that print"
            )
    if isinstance(value, int | float) and not abs(value) <= LARGEST:
        raise WrongValue(f"{what} is {value}, allowed is a number up to 2 to the 128th")


def require_word(what: str, value: Any) -> None:
    """Raise WrongValue unless the value is a short name without spaces, to be typed as one."""
    require(what, value, str)
    if not value.strip():
        raise WrongValue(f"{what} is empty, allowed is a name")
    if len(value) > LONGEST_NAME:
        raise WrongValue(f"{what} has {len(value)} characters, allowed are {LONGEST_NAME}")
    if len(value.split()) > 1:
        raise WrongValue(f"{what} is {shown(value)}, allowed is one word")


def checked(function: Callable[P, T]) -> Callable[P, T]:
    """The function of a grammar; called with a value of another type than it has, WrongValue."""
    accepts = signature(function)

    @wraps(function)
    def call(*values: P.args, **named: P.kwargs) -> T:
        types = _types(function)
        owner = function.__qualname__.removesuffix(".__init__")
        for name, value in accepts.bind(*values, **named).arguments.items():
            if name in types:  # self has none
                several = accepts.parameters[name].kind is Parameter.VAR_POSITIONAL
                for one in value if several else (value,):
                    require(f"{owner}.{name}", one, types[name])
        return function(*values, **named)

    return call


@cache
def _types(of: Callable[..., Any]) -> Mapping[str, Any]:
    return get_type_hints(of, include_extras=True)


class Declared(msgspec.Struct, frozen=True):
    """A declaration of a grammar. Raises WrongValue for a value of another type than it has."""

    def __post_init__(self) -> None:
        types = _types(type(self))
        for name in self.__struct_fields__:
            require(f"{type(self).__name__}.{name}", getattr(self, name), types[name])
