"""Random filters for Hypothesis, and what each of them means for the values of a row."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeAlias

from hypothesis import strategies as st

from bilprov.analyzer.filters.fields import Field, Kind, fields_of
from bilprov.spec.protocol import Protocol

Values: TypeAlias = Mapping[str, Any]
Condition: TypeAlias = tuple[str, Callable[[Values], bool]]
"""A condition as it is written, and what it means for the values of a row."""

SIGNS = {"==": operator.eq, "!=": operator.ne, "<": operator.lt, ">=": operator.ge}


@st.composite
def conditions(draw: Callable[..., Any], protocol: Protocol) -> Condition:
    """A few comparisons, joined."""
    fields = [one for one in fields_of(protocol).values() if one.kind is not Kind.CLOCK]
    text, holds = draw(st.sampled_from(fields).flatmap(comparisons))
    for _ in range(draw(st.integers(0, 2))):
        more, also = draw(st.sampled_from(fields).flatmap(comparisons))
        text, holds = draw(st.sampled_from(_joined(text, holds, more, also)))
    return text, holds


def _joined(
    text: str, holds: Callable[[Values], bool], more: str, also: Callable[[Values], bool]
) -> list[Condition]:
    return [
        (f"({text}) and not {more}", lambda row: holds(row) and not also(row)),
        (f"{more} or {text}", lambda row: holds(row) or also(row)),
        (f"!({text}) && ({more})", lambda row: also(row) and not holds(row)),
    ]


def comparisons(field: Field) -> st.SearchStrategy[Condition]:
    """One comparison of a field with a value that it may have."""
    name = field.name

    def condition(text: str, holds: Callable[[Any], bool]) -> Condition:
        return text, lambda row: row.get(field.key) is not None and holds(row[field.key])

    def signed(value: Any, written: object) -> list[Condition]:
        return [
            condition(f"{name} {sign} {written}", partial(_turned(compare), value))
            for sign, compare in SIGNS.items()
            if sign in field.signs
        ]

    def contains(part: Any, written: object) -> Condition:
        return condition(f"{name} contains {written}", lambda whole: part in whole)

    def numbers(ends: list[int]) -> list[Condition]:
        first, last = sorted(ends)
        found = [condition(f"{name} in {first}..{last}", lambda value: first <= value <= last)]
        if field.kind is Kind.SECONDS:
            return [*found, *signed(first / 1000, f"{first}ms")]
        bit = high.bit_length() - 1
        if low >= 0:
            found.append(condition(f"{name} & {1 << bit}", lambda value: value >> bit & 1 == 1))
        return [*found, *signed(first, first)]

    def octets(part: bytes) -> list[Condition]:
        byte, text = part[0] % 3, part.hex(" ")
        return [
            contains(part, text),
            *signed(part, text),
            *signed(b"", "''"),
            condition(f"{name}[{byte}] >= 32", lambda d: len(d) > byte and d[byte] >= 32),
        ]

    def words(word: str) -> list[Condition]:
        if field.kind is Kind.WORDS:
            return [contains(word, repr(word))]
        return signed(field.words[word], repr(word))

    if field.kind in (Kind.NUMBER, Kind.SECONDS):
        low = -1 if field.low is None else field.low
        high = 300 if field.high is None else field.high
        inside = st.integers(low + 1, max(low + 1, min(high - 1, low + 300)))
        found = st.lists(inside, min_size=2, max_size=2).map(numbers)
    elif field.kind is Kind.BYTES:
        found = st.sampled_from([b"\0", b"\x11", b"\x81\x09", b"\0\0\0"]).map(octets)
    elif field.kind is Kind.TEXT:
        texts = st.sampled_from(["LED", "ms", "header", "byte"])
        found = texts.map(lambda part: [contains(part, part)])
    else:
        found = st.sampled_from([*field.words]).map(words)
    return found.flatmap(st.sampled_from)


def _turned(compare: Callable[[Any, Any], bool]) -> Callable[[Any, Any], bool]:
    return lambda value, of_row: compare(of_row, value)


_CLOCKS = ("time >= 13:46:40", "time in 00:00..13:47", "time < 2026-09-21 13:46:41.5")


@st.composite
def expressions(draw: Callable[..., Any], protocol: Protocol) -> str:
    """Filters that compile: comparisons of all kinds, joined."""
    text, _ = draw(conditions(protocol))
    return draw(st.sampled_from([text, text, f"({text}) or {draw(st.sampled_from(_CLOCKS))}"]))
