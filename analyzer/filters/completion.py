"""What may come next in a filter that is being typed: names, signs, values and units."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from bilprov.analyzer.filters.fields import Field, Kind, bytes_names, fields_of, find, folded
from bilprov.analyzer.filters.syntax import CLOSING, Part, Place, place_at_end
from bilprov.spec.protocol import Protocol


class Completion(NamedTuple):
    """A way to go on: `text` takes the place of what stands from `start` to the cursor.

    `says` tells in words what it is, empty where the text says it.
    """

    text: str
    start: int
    says: str = ""


_BEGUN = re.compile(r"(?:(?<![\w.])|(?<=\.\.))[^\W\d][\w.]*$")  # a word at the end
_SIGNS = {
    "in": "is one of {1, 2} or 1..2",
    "contains": "has it inside",
    "&": "has these bits",
}


def completions(text: str, cursor: int, protocol: Protocol) -> list[Completion]:
    """The ways to go on with a filter at the cursor (a place from 0), the best known ones first.

    There are none where the text before the cursor cannot become a filter, and where anything of a
    kind may come, as behind `speed >`.
    """
    text = text[:cursor]
    begun = _BEGUN.search(text)
    start = begun.start() if begun else len(text)
    place, same = place_at_end(text[:start], bytes_names(protocol)), folded(text[start:])
    if place is None:
        return []
    # What joins needs a blank before it, what closes does not.
    blank = " " if not place.wanted and text[start - 1 : start].strip() else ""
    return [
        Completion(_written(word, blank), start, says)
        for word, says in _words(place, protocol, same)
        if folded(word).startswith(same)
    ]


def _written(word: str, blank: str) -> str:
    """A word as it is written: a value in quotes if it is not one word, the others as they are."""
    if " " in word:
        return f"'{word}'"
    return word if word in (",", *CLOSING.values()) else blank + word


def _words(place: Place, protocol: Protocol, typed: str) -> Iterator[tuple[str, str]]:
    """The words that may stand at a place, each with what it says."""
    field = _field(place.left, protocol)
    if place.wanted and place.left is not None:
        if field is not None:
            yield from _values(field, place)
    elif place.wanted:
        yield from _names(protocol, typed)
    elif place.listed:
        yield ",", "and another value"
        yield CLOSING[place.open], "no more values"
    else:
        if field is not None and not place.compared:
            yield from ((sign, _SIGNS.get(sign, "")) for sign in field.signs)
        whole = place.left and place.left.kind in ("bits", "compared", "and", "or", "not")
        if place.compared or whole or (field is not None and field.kind is Kind.TRUTH):
            yield "and", "both hold"
            yield "or", "one of them holds"
            if place.open:
                yield CLOSING[place.open], ""


def _names(protocol: Protocol, typed: str) -> Iterator[tuple[str, str]]:
    """The names of the row. The long ones of fields are known to whoever begins them."""
    for name, field in fields_of(protocol).items():
        if not name.startswith("fields.") or typed.startswith("fields"):
            yield name, field.says
    yield "not", "the opposite holds"


def _values(field: Field, place: Place) -> Iterator[tuple[str, str]]:
    """The names of a field's values, each with the number that it stands for."""
    if place.sign.endswith("in") and not place.listed:
        if field.words:
            yield "{", "one of several"
        return
    for word, value in field.words.items():
        yield word, f"{field.name} {value}" if type(value) is int else ""


def _field(part: Part | None, protocol: Protocol) -> Field | None:
    """The field that a part asks for, None for a value or a condition."""
    if part and part.kind == "item":
        return Field("", Kind.NUMBER, "")
    return find(protocol, part.text) if part and part.kind == "word" else None
