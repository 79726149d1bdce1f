"""Completes what is typed: instructions, their fields and values, and words. Knows no terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from bilprov.analyzer.cli.typed_input import PAUSE, SEPARATOR
from bilprov.spec.codec import bit_names, free_parts
from bilprov.spec.data import FieldSpec
from bilprov.spec.layout import Part
from bilprov.spec.protocol import Protocol

_LISTED = 16  # values that are listed one by one; of a wider range its two ends


class Candidate(NamedTuple):
    """A text that may take the place of the last `replaced` characters, and what it means."""

    text: str
    replaced: int
    meaning: str


def candidates(protocol: Protocol, words: Mapping[str, str], line: str) -> Iterator[Candidate]:
    """Yield what may stand at the end of `line`, the text before the cursor.

    `words` are the words that can be typed besides instructions, with their meanings.
    """
    item = line.rpartition(SEPARATOR)[2].lstrip()
    name, space, rest = item.partition(" ")
    if space:
        yield from _of_fields(protocol, name, rest)
        return
    names = {spec.name: spec.prose for spec in protocol.instructions}
    known = {text.lower() for text in names}
    others = {word: meaning for word, meaning in words.items() if word not in known}
    for text, meaning in {**names, **others, PAUSE: "milliseconds"}.items():
        if text.lower().startswith(name.lower()):
            yield Candidate(text, len(name), meaning)


def _of_fields(protocol: Protocol, name: str, rest: str) -> Iterator[Candidate]:
    """Yield the fields that are not given yet, or the values of the one that is typed."""
    spec = next((s for s in protocol.instructions if s.name.lower() == name.lower()), None)
    if spec is None:
        return
    *given, typed = rest.split(" ")
    field, equals, value = typed.partition("=")
    taken = {word.partition("=")[0].lower() for word in given}
    parts: list[FieldSpec | Part] = [part for part in spec.fields if part.constant is None]
    for part in (*parts, *free_parts(protocol)):
        if equals and part.name.lower() == field.lower():
            yield from (one for one in _of_values(part, len(value)) if one.text.startswith(value))
            return
        begins = part.name.lower().startswith(typed.lower())
        if begins and not equals and part.name.lower() not in taken:
            allowed = (
                f"{part.low}..{part.high}" if isinstance(part, Part) else part.allowed_in_short
            )
            meaning = f"{allowed}, {part.prose}"
            yield Candidate(f"{part.name}=", len(typed), meaning)


def _of_values(part: FieldSpec | Part, replaced: int) -> Iterator[Candidate]:
    if isinstance(part, Part):
        yield from (Candidate(str(end), replaced, part.prose) for end in (part.low, part.high))
        return
    if part.many:
        return
    if part.names:
        yield from (Candidate(name, replaced, str(value)) for name, value in part.names)
        return
    listed = part.high - part.low < _LISTED
    for value in range(part.low, part.high + 1) if listed else (part.low, part.high):
        bits = " ".join(bit_names(part, value)) or ("off" if part.bits else "")
        yield Candidate(str(value), replaced, bits or part.prose)
