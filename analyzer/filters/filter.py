"""Compiles filter expressions (`--filter EXPR`) and asks which rows of a batch pass.

A parsed filter is checked against a protocol, and becomes a test of columns (`masks`). A value that
a name can never have is a mistake: the error says what was meant. A whole number is an int, seconds
are in s. A row that lacks a value passes no comparison with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal
from typing import TYPE_CHECKING, NamedTuple, NoReturn

from bilprov.analyzer.filters import fields, masks
from bilprov.analyzer.filters.fields import Field, Instant, Kind, Value, folded
from bilprov.analyzer.filters.masks import DATE, TIME_OF_DAY, Operand, Test
from bilprov.analyzer.filters.syntax import TEXTS, Part, octets_of, parse, refuse, refuse_part
from bilprov.captures.text import near
from bilprov.captures.wall_clock import LONGEST
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch, Selection


_TURNED = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "==": "==", "!=": "!="}
_TURNED |= {"in": "contains", "not in": "not contains"}
_WHAT = {
    "number": "a number",
    "quoted": "text",
    "moment": "a time of day",
    "bytes": "bytes",
    "item": "a byte of the row",
    "bits": "bits of the row",
}
_LARGEST = 1e30


class _Checker:
    """Checks the parts of one filter. Its methods raise FilterError."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol

    # Conditions

    def condition(self, part: Part) -> Test:
        """What is true or false by itself."""
        match part.kind:
            case "and" | "or":
                return masks.joined([*map(self.condition, part.parts)], part.kind == "and")
            case "not":
                return masks.negated(self.condition(part.parts[0]))
            case "compared":
                operands, signs = part.parts[::2], part.parts[1::2]
                return masks.joined([*map(self._comparison, operands, signs, operands[1:])], True)
        operand, field = self._operand(part)
        if part.kind == "bits":
            return masks.compared(operand, "!=", 0)
        if field.kind is not Kind.TRUTH:
            kind = field.kind_of
            refuse_part(part, f"is {kind}, not a condition: compare it, like {field.example}")
        return masks.compared(operand, "==", True)

    def _comparison(self, left: Part, sign: Part, right: Part) -> Test:
        left, right = self._beside(left, right), self._beside(right, left)
        one, other = self._field(left), self._field(right)
        # A word that names a value of the other side is one: `name == speed`.
        if one and _named(right, one) is not None:
            other = None
        elif other and _named(left, other) is not None:
            one = None
        if one and other and one.kind is not Kind.TEXT and not sign.text.endswith("contains"):
            return self._two_fields(left, sign, right)
        if one:
            return self._with_value(left, sign, right)
        if other and sign.text in _TURNED:  # 100 < speed
            return self._with_value(right, sign._replace(text=_TURNED[sign.text]), left)
        return self._refuse_value(left)

    def _beside(self, part: Part, other: Part) -> Part:
        """A word beside numbers: a name, though it is spelled like a value (`Speed > 3`)."""
        numbers = other.kind in ("number", "range", "set")
        if part.kind == "word" and numbers and fields.find(self._protocol, part.text) is None:
            field = fields.by_folded(self._protocol).get(folded(part.text))
            return part._replace(text=field.name) if field else part
        return part

    def _two_fields(self, left: Part, sign: Part, right: Part) -> Test:
        (operand, one), (with_operand, other) = self._operand(left), self._operand(right)
        _require_sign(one, sign)
        if sign.text.endswith("in") or one.kind is other.kind is Kind.BYTES:
            refuse_part(right, f"is a name of the row, and {sign.text} takes values")
        if one.kind is not other.kind:
            kinds = f"{one.name} is {one.kind_of}, {other.name} is {other.kind_of}"
            refuse(right, f"{kinds}: these never meet")
        if one == other:
            refuse(right, "both sides are the same")
        return masks.alike(operand, sign.text, with_operand)

    def _with_value(self, left: Part, sign: Part, right: Part) -> Test:
        """A comparison of a field with what is the same in all rows."""
        operand, field = self._operand(left)
        _require_sign(field, sign)
        if sign.text.endswith("contains"):
            return self._containing(operand, field, sign, right)
        if not sign.text.endswith("in"):
            return self._compared(operand, field, sign.text, right)
        if right.kind not in ("set", "range"):
            refuse(right, f"in takes a set like {{{right.shown}}} or a range like 1..2")
        several = right.parts if right.kind == "set" else (right,)
        return _among(sign, operand, [self._element(operand, field, part) for part in several])

    def _compared(self, operand: Operand, field: Field, sign: str, part: Part) -> Test:
        """A comparison with a value that can hold."""
        found = self._value(part, field)
        if isinstance(found, Instant):
            clock = masks.of_row(TIME_OF_DAY if found.daily else DATE)
            return masks.compared(clock, sign, found.ns)
        if isinstance(found, int | float):
            _require_possible(field, sign, found, part)
        return masks.compared(operand, sign, found)

    def _element(self, operand: Operand, field: Field, part: Part) -> Test:
        """Whether it is one of a set: a value, or in a range of them."""
        if part.kind != "range":
            if field.kind is Kind.CLOCK:
                refuse(part, "no row matches a moment exactly: write 14:03:20..14:03:21")
            return self._compared(operand, field, "==", part)
        low, high = (self._value(end, field) for end in part.parts)
        over_midnight = False
        if isinstance(low, Instant) and isinstance(high, Instant):
            over_midnight = low.daily and high.daily and high < low
            ordered = low.daily is high.daily and (low <= high or over_midnight)
        elif isinstance(low, int | float) and isinstance(high, int | float):
            ordered = low <= high
        else:
            refuse(part, f"{field.name} is {field.kind_of}, which has no ranges: name each value")
        if not ordered:
            refuse(part, f"the range ends at {part.parts[1].shown}, before it begins")
        first, last = part.parts
        since = self._compared(operand, field, ">=", first)
        return masks.joined([since, self._compared(operand, field, "<=", last)], not over_midnight)

    def _containing(self, operand: Operand, field: Field, sign: Part, right: Part) -> Test:
        if field.kind in (Kind.WORDS, Kind.BYTES):
            words = field.kind is Kind.WORDS
            found = self._word(right, field) if words else self._value(right, field)
            if not found:
                refuse(right, "contains takes at least one byte, like 11 or 11 ff")
            assert not isinstance(found, Instant)
            return masks.compared(operand, sign.text, found)
        if right.kind not in TEXTS or not right.text:
            refuse_part(right, f"is not a text; write {field.name} contains 'text'")
        if field.kind is Kind.TEXT:
            return masks.compared(operand, sign.text, right.text)
        same = folded(right.text)
        named = [value for word, value in field.words.items() if same in folded(word)]
        if not named:
            refuse_part(right, f"is in no {field.name}; there are {field.listed}")
        # A row's word may be several, as of the flags of an answer.
        same_or_has = "contains" if field.kind is Kind.WORD else "=="
        return _among(sign, operand, [masks.compared(operand, same_or_has, v) for v in named])

    # Operands

    def _field(self, part: Part) -> Field | None:
        """The field that a part asks the row for, None for what is the same in all rows."""
        if part.kind in ("compared", "and", "or", "not"):
            refuse(part, "a condition is not compared: join it with and, or, not")
        if part.kind == "word":
            return fields.find(self._protocol, part.text)
        return self._operand(part)[1] if part.kind in ("item", "bits") else None

    def _operand(self, part: Part) -> tuple[Operand, Field]:
        """What a part asks the row for, and as a field: its kind and its limits."""
        if part.kind == "item":
            of, index = part.parts
            _, field = self._operand(of)
            place = _number(index)
            if not isinstance(place, int) or index.parts or place < 0:
                refuse_part(index, f"is not a position: {field.name}[0] is the first byte")
            byte = Field(part.shown, Kind.NUMBER, "a byte", low=0, high=255)
            return masks.of_row(field.key, place), byte
        if part.kind == "bits":
            left, right = part.parts
            operand, field = self._operand(left)
            if field.kind is not Kind.NUMBER or "&" not in field.signs:
                refuse_part(left, f"is {field.kind_of}, and & takes whole numbers")
            mask = self._value(right, field)
            if not isinstance(mask, int) or not 0 < mask < 1 << 63:
                refuse_part(right, "is not a mask; & takes a whole number like 4 or 0x80")
            bits = Field(part.shown, Kind.NUMBER, "bits", low=0, high=mask)
            return masks.masked(operand, mask), bits
        found = self._field(part)
        if found is None:
            self._refuse_value(part)
        return masks.of_row(found.key), found

    # Values

    def _value(self, part: Part, field: Field) -> float | str | bytes | frozenset[str] | Instant:
        """What a part stands for beside a field."""
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
                moment = fields.instant(part.text) if part.kind in ("moment", "quoted") else None
                if moment is None:
                    why = "is not a time of day like 14:03:20; seconds since the start are t"
                    refuse_part(part, why)
                return moment
            case Kind.WORDS, _:
                kinds = part.parts if part.kind == "set" else (part,)
                return frozenset(str(self._word(kind, field)) for kind in kinds)
        return self._word(part, field)

    def _word(self, part: Part, field: Field) -> Value:
        """The value of a field that a word names."""
        known = _named(part, field)
        if known is not None:
            return known
        if part.kind in TEXTS and field.words:
            meant = near(part.text, field.words)
            hint = f"did you mean {meant}?" if meant else f"there are {field.listed}"
            refuse_part(part, f"is not a value of {field.name} in this grammar: {hint}")
        if part.kind == "word":
            self._refuse_unknown(part)
        if part.kind in ("range", "set"):
            refuse(part, "a set or a range follows in, like id in {1, 2} or t in 1s..2s")
        what, kind = _WHAT.get(part.kind, "a condition"), field.kind_of
        return refuse_part(part, f"is {what}, and {field.name} is {kind}: write {field.example}")

    # What is a mistake

    def _refuse_value(self, part: Part) -> NoReturn:
        """Refuse a value that stands where a name should."""
        if part.kind == "word":
            names = self._owners(part.text)
            if not names:
                self._refuse_unknown(part)
            refuse_part(part, f"is a value, not a condition: write {names[0]} == {part.shown}")
        refuse_part(part, "asks nothing of the row: compare a name with it, like latency > 20ms")

    def _refuse_unknown(self, part: Part) -> NoReturn:
        """Refuse a word that is no name, and no value that fits."""
        names, known = fields.fields_of(self._protocol), fields.find(self._protocol, part.text)
        if known is not None:
            refuse_part(part, f"is {known.kind_of}, which does not fit here")
        if owners := self._owners(part.text):
            refuse_part(part, f"is a value of {owners[0]}, which does not fit here")
        meant = near(part.text, [*names, *(w for field in names.values() for w in field.words)])
        short = dict.fromkeys(f"{n.split('.')[0]}.*" if "." in n else n for n in names)
        hint = f"did you mean {meant}?" if meant else f"there are {', '.join(short)}"
        refuse_part(part, f"is not a name here: {hint}")

    def _owners(self, text: str) -> list[str]:
        """The names of which a word is a value, `name` first."""
        known = fields.fields_of(self._protocol).values()
        return sorted((f.name for f in known if f.value_of(text) is not None), key="name".__ne__)


def _named(part: Part, field: Field) -> Value | None:
    """The value of the field that a word names, in quotes or not; None if it names none."""
    return field.value_of(part.text) if part.kind in TEXTS else None


def _measured(part: Part, field: Field) -> float:
    """The value of a number beside a field, in its unit."""
    plain = _number(part)
    if not part.parts:
        return plain
    (unit,) = part.parts
    if field.kind is Kind.NUMBER:
        refuse_part(unit, f"does not fit: {field.name} has no unit, so write {part.text}")
    power = fields.UNITS.get(unit.text)
    if power is None:
        refuse_part(unit, "is not a unit of time; there are us, ms and s")
    # Read as one number: the nearest to it, as a row's time is the nearest to its nanoseconds.
    written = plain if isinstance(plain, int) else part.text.replace("_", "")
    return float(Decimal(written).scaleb(power))


def _number(part: Part) -> float:
    """A number without its unit; a whole one is an int."""
    text = part.text.lower().replace("_", "")
    try:
        number: float = int(text, 10 if text.lstrip("+-").isdecimal() else 0)
    except ValueError:
        number = float(text)
    if abs(number) > _LARGEST:
        refuse_part(part, "is too large")
    return int(number) if number == int(number) else number


def _require_sign(field: Field, sign: Part) -> None:
    text = sign.text.removeprefix("not ")
    if text not in field.signs:
        refuse(sign, f"{field.name} is {field.kind_of}, without {text}: write {field.example}")


def _require_possible(field: Field, sign: str, number: float, part: Part) -> None:
    """Refuse a number with which a comparison can never hold."""
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
        refuse(part, f"{field.name} is {of}, so {field.name} {sign} {part.shown} never holds")


def _among(sign: Part, operand: Operand, elements: Sequence[Test]) -> Test:
    """Whether a value is one of these, or (behind `not`) there is one and it is none of them."""
    among = masks.joined(elements, False)
    if not sign.text.startswith("not"):
        return among
    # Only a value is the same as itself: a row that lacks it passes no comparison.
    return masks.joined([masks.alike(operand, "==", operand), masks.negated(among)], True)


class Filter(NamedTuple):
    """A compiled filter.

    `start` is the wall clock (ns since 1970) at the recording's start. Where it is not known no row
    has a time of day, and no comparison with `time` holds.
    """

    test: Test
    protocol: Protocol
    start: int | None = None

    def started(self, start_wall: int) -> Filter:
        """The filter for a recording that began at this time (ns since 1970).

        A start that no clock shows (0 or less, or after the year 2116) counts as unknown.
        """
        return self._replace(start=start_wall if 0 < start_wall < LONGEST else None)

    def selection(self, batch: Batch) -> Selection:
        """Which rows of a batch pass."""
        return masks.selection(self.test, self.protocol, batch, self.start)


def compile_filter(text: str, protocol: Protocol) -> Filter:
    """Compile a filter, which asks for rows of this protocol.

    The names are those of `fields_of(protocol)`. Raises FilterError, in one sentence that begins
    with the column.
    """
    test = _Checker(protocol).condition(parse(text, fields.bytes_names(protocol)))
    return Filter(test, protocol)
