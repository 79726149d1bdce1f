"""Foreign JSON and TOML as safe values, so that nothing behind this distrusts what it gets."""

from __future__ import annotations

import tomllib
from typing import Any, TypeVar

import msgspec

from bilprov.captures.text import escape_controls

LONGEST_TEXT = 1 << 18
"""Characters of one text; the bytes of the largest read of a port as hex are fewer."""
LARGEST_NUMBER = 1 << 63
DEEPEST = 50
"""How many values may lie within each other."""
_DEEP = "too many of its values lie within each other"

Value = TypeVar("Value")


def safe(value: Any, room: int = DEEPEST) -> Any:
    """The same value of dicts, lists and tuples in which every text prints and has a bound.

    What does not print in a text, or a key, becomes an escape like `\\x1b`; a text beyond
    LONGEST_TEXT is cut, a whole number beyond LARGEST_NUMBER becomes that. Raises ValueError
    for more values within each other than there is `room` for.
    """
    if not room:
        raise ValueError(_DEEP)
    if isinstance(value, str):
        return escape_controls(value[:LONGEST_TEXT])[:LONGEST_TEXT]
    if isinstance(value, dict):
        return {safe(key): safe(inner, room - 1) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(safe(inner, room - 1) for inner in value)
    if type(value) is int:
        return max(-LARGEST_NUMBER, min(value, LARGEST_NUMBER))
    return value


def from_json(data: bytes, kind: type[Value]) -> Value:
    """The value of this type that JSON holds, made safe. Raises ValueError, in one sentence."""
    try:
        return msgspec.convert(safe(msgspec.json.decode(data)), kind)
    except RecursionError as error:
        raise ValueError(_DEEP) from error


def from_toml(text: str) -> dict[str, Any]:
    """The table that TOML holds, made safe. Raises ValueError, in one sentence."""
    try:
        table: dict[str, Any] = safe(tomllib.loads(text))
    except RecursionError as error:
        raise ValueError(_DEEP) from error
    return table
