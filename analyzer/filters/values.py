"""Reads the values in a filter: what a number, a word, a moment or bytes stand for beside a name.

A value that the name can never have is a mistake, and so is a unit that does not fit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple, NoReturn

from bilprov.analyzer.filters.fields import Field, Kind, Value, fields_of, find
from bilprov.analyzer.filters.syntax import FilterError, Part, octets_of
from bilprov.captures.text import near, printable
from bilprov.spec.protocol import Protocol

SECOND = 1_000_000_000  # ns
DAY = 86_400 * SECOND  # ns
STEP = 900 * SECOND
"""Ns between the moments at which a time zone may change its offset: all do at a quarter."""


class Instant(NamedTuple):
    """A moment in ns: since midnight if it is `daily`, or else since 1970."""

    daily: bool
    ns: int


def instant(text: str) -> Instant | None:
    """The moment that is written as `14:03:20`, `2026-11-22 14:03:20` or `2026-11-22`.

    Minutes are enough, and microseconds count. A date is local, unless `Z` or an offset like
    `+02:00` stands behind it. None for what is no moment.
    """
    from datetime import datetime
    from datetime import time as clock

    try:
        if "-" in text[:5]:
            since = datetime.fromisoformat(text).timestamp()
            return Instant(False, round(since * 1e6) * 1000)
        at = clock.fromisoformat(f"0{text}" if text[1:2] == ":" else text)
    except (ValueError, OverflowError, OSError):
        return None
    seconds = (at.hour * 60 + at.minute) * 60 + at.second
    return None if at.tzinfo else Instant(True, seconds * SECOND + at.microsecond * 1000)


@lru_cache(maxsize=4096)
def offset(step: int) -> int:
    """How far (ns) local time is ahead of UTC from a moment on: a number of STEPs since 1970."""
    return time.localtime(step * STEP // SECOND).tm_gmtoff * SECOND


UNITS: Mapping[str, int] = {"us": -6, "ms": -3, "s": 0, "µs": -6, "μs": -6}  # both letters mu
"""The units of time, each as the power of ten that it is of a second."""

_MOST_LISTED = 12  # values that a sentence lists
_LARGEST = 1e30


def value(
    protocol: Protocol, part: Part, field: Field
) -> float | str | bytes | frozenset[str] | Instant:
    """What a part stands for beside a field: a whole number is an int, seconds are in s.

    Raises FilterError for a value of another kind, and for a word that names none of its values.
    """
    match field.kind, part.kind:
        case Kind.NUMBER | Kind.SECONDS, "number":
            return _measured(part, field)
        case Kind.BYTES, "bytes" | "quoted":
            data = octets_of(part.text)
            if data is None:
                refuse_part(part, f"is not hex; {field.name} is bytes, written like 11 ff")
            return data
        case Kind.TEXT, "word" | "quoted":
            return part.text
        case Kind.CLOCK, _:
            return _instant(part)
        case Kind.WORDS, _:
            kinds = part.parts if part.kind == "set" else (part,)
            return frozenset(str(word(protocol, kind, field)) for kind in kinds)
    return word(protocol, part, field)


def named(part: Part, field: Field) -> Value | None:
    """The value of the field that a word names, in quotes or not; None if it names none."""
    return field.value_of(part.text) if part.kind in TEXTS else None


def word(protocol: Protocol, part: Part, field: Field) -> Value:
    """The value of a field that a word names. Raises FilterError if it names none."""
    known = named(part, field)
    if known is not None:
        return known
    if part.kind not in TEXTS or not field.words:
        refuse_kind(protocol, part, field)
    meant = near(part.text, field.words)
    hint = f"did you mean {meant}?" if meant else f"there are {listed(field)}"
    return refuse_part(part, f"is not a value of {field.name} in this grammar: {hint}")


def _instant(part: Part) -> Instant:
    """The moment that a part stands for. Raises FilterError."""
    found = instant(part.text) if part.kind in ("moment", "quoted") else None
    if found is None:
        refuse_part(part, "is not a time of day like 14:03:20; seconds since the start are t")
    return found


def require_possible(field: Field, sign: str, number: float, part: Part) -> None:
    """Refuse a number with which a comparison can never hold. Raises FilterError."""
    low = -math.inf if field.low is None else field.low
    high = math.inf if field.high is None else field.high
    possible = {
        "!=": True,
        "<": number > low,
        "<=": number >= low,
        ">": number < high,
        ">=": number <= high,
    }
    reached = low <= number <= high and (field.kind is not Kind.NUMBER or isinstance(number, int))
    if not possible.get(sign, reached):
        reach = f"{field.low} or more" if field.high is None else f"{field.low} to {field.high}"
        of = "a whole number" if field.low is None else reach
        refuse(part, f"{field.name} is {of}, so {field.name} {sign} {shown(part)} never holds")


def owners(protocol: Protocol, text: str) -> list[str]:
    """The names of which a word is a value, `name` first."""
    fields = sorted(fields_of(protocol).values(), key=lambda field: field.name != "name")
    return [field.name for field in fields if field.value_of(text) is not None]


def whole_number(part: Part) -> int | None:
    """The number that a part is, None if it has a unit or is not whole. Raises FilterError."""
    found = _number(part)
    return found if isinstance(found, int) and not part.parts else None


def _measured(part: Part, field: Field) -> float:
    """The value of a number beside a field, in its unit. Raises FilterError."""
    plain = _number(part)
    if not part.parts:
        return plain
    (unit,) = part.parts
    if field.kind is Kind.NUMBER:
        refuse_part(unit, f"does not fit: {field.name} has no unit, so write {part.text}")
    power = UNITS.get(unit.text)
    if power is None:
        refuse_part(unit, "is not a unit of time; there are us, ms and s")
    from decimal import Decimal

    # Read as one number: the nearest to it, as a row's time is the nearest to its nanoseconds.
    written = plain if isinstance(plain, int) else part.text.replace("_", "")
    return float(Decimal(written).scaleb(power))


def _number(part: Part) -> float:
    """A number without its unit; a whole one is an int. Raises FilterError."""
    text = part.text.lower().replace("_", "")
    try:
        try:
            number: float = int(text, 10 if text.lstrip("+-").isdecimal() else 0)
        except ValueError:
            number = float(text)
    except ValueError:
        refuse_part(part, "is not a number")
    if abs(number) > _LARGEST:
        refuse_part(part, "is too large")
    return int(number) if float(number).is_integer() else number


# Sentences


def refuse(part: Part, sentence: str) -> NoReturn:
    """Raise FilterError with a sentence about a part."""
    raise FilterError(sentence, part.start, part.end)


def refuse_part(part: Part, rest: str) -> NoReturn:
    """Raise FilterError with a sentence that begins with the part itself."""
    refuse(part, f"{shown(part)!r} {rest}" if shown(part) else f"this {rest}")


def refuse_kind(protocol: Protocol, part: Part, field: Field) -> NoReturn:
    """Refuse a value of another kind than the field's. Raises FilterError."""
    if part.kind == "word":
        refuse_unknown(protocol, part)
    if part.kind in ("range", "set"):
        refuse(part, "a set or a range follows in, like id in {1, 2} or t in 1s..2s")
    what = _WHAT.get(part.kind, "a condition")
    refuse_part(part, f"is {what}, and {field.name} is {kind_of(field)}: write {example(field)}")


def refuse_unknown(protocol: Protocol, part: Part) -> NoReturn:
    """Refuse a word that is no name, and no value that fits. Raises FilterError."""
    fields, known = fields_of(protocol), find(protocol, part.text)
    if known is not None:
        refuse_part(part, f"is {kind_of(known)}, which does not fit here")
    if known_of := owners(protocol, part.text):
        refuse_part(part, f"is a value of {known_of[0]}, which does not fit here")
    meant = near(part.text, [*fields, *(w for field in fields.values() for w in field.words)])
    names = dict.fromkeys(name if "." not in name else f"{name.split('.')[0]}.*" for name in fields)
    hint = f"did you mean {meant}?" if meant else f"there are {', '.join(names)}"
    refuse_part(part, f"is not a name here: {hint}")


def kind_of(field: Field) -> str:
    """What kind of value a field has, in words."""
    if field.kind is Kind.WORD:
        return f"a word like {next(iter(field.words))}"
    named = field.kind is Kind.NUMBER and field.words
    return f"{field.kind} or a name like {next(iter(field.words))}" if named else str(field.kind)


def example(field: Field) -> str:
    """A condition with a field."""
    name = field.name
    if field.kind is Kind.WORDS:
        return f"{name} contains {next(iter(field.words))!r}"
    if field.words:
        return f"{name} == {next(iter(field.words))}"
    return {
        Kind.SECONDS: f"{name} > 20ms",
        Kind.CLOCK: f"{name} > 14:03:20",
        Kind.TEXT: f"{name} contains 'late'",
        Kind.BYTES: f"{name} contains 11 ff",
    }.get(field.kind, f"{name} > {field.low or 0}")


def listed(field: Field) -> str:
    """The names of a field's values, as many as fit into a sentence."""
    words = list(field.words)
    more = f" and {len(words) - _MOST_LISTED} more" if len(words) > _MOST_LISTED else ""
    return ", ".join(words[:_MOST_LISTED]) + more


def shown(part: Part) -> str:
    """A part as it was written, or empty for what is longer than a value."""
    match part.kind, part.parts:
        case "item", (of, index):
            return f"{of.text}[{index.text}]"
        case "bits", (left, right):
            return f"{shown(left)} & {shown(right)}"
        case "number", (unit,):
            return printable(part.text + unit.text)
    return printable(part.text)


TEXTS = ("word", "quoted")
"""The kinds of parts that are text, with or without quotes."""

_WHAT = {
    "number": "a number",
    "quoted": "text",
    "moment": "a time of day",
    "bytes": "bytes",
    "item": "a byte of the row",
    "bits": "bits of the row",
}
