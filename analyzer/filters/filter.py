"""Compiles filter expressions (`--filter EXPR`) and asks which rows of a batch pass.

A parsed filter is checked against a protocol, and turned into a tree of plain values, whose meaning
for rows stands in `masks`. What can never hold, or asks nothing of a row, is a mistake: the error
says what was meant. A row that lacks a value passes no comparison with it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NoReturn

from bilprov.analyzer.filters import tree, values
from bilprov.analyzer.filters.fields import Field, Kind, bytes_names, find, folded
from bilprov.analyzer.filters.syntax import FilterError, Part, parse
from bilprov.analyzer.filters.values import Instant, kind_of, owners, refuse, refuse_part, shown
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch, Selection


_TURNED = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "==": "==", "!=": "!="}


def checked(part: Part, protocol: Protocol) -> tree.Node:
    """The tree of a parsed filter. Raises FilterError."""
    return _Checker(protocol).condition(part)


class _Checker:
    """Checks the parts of one filter."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        # What was found out about each part with &: it is asked for several times.
        self._known: dict[Part, tuple[tree.Operand, Field]] = {}

    # Conditions

    def condition(self, part: Part) -> tree.Node:
        """What is true or false by itself. Raises FilterError."""
        match part.kind:
            case "and" | "or":
                return tree.Joined(part.kind == "and", tuple(map(self.condition, part.parts)))
            case "not":
                return tree.Not(self.condition(part.parts[0]))
            case "compared":
                operands, signs = part.parts[::2], part.parts[1::2]
                return _joined(True, map(self._comparison, operands, signs, operands[1:]))
        if self._field(part) is None or values.only_a_value(self._protocol, part):
            self._refuse_value(part)
        operand, field = self._operand(part)
        if isinstance(operand, tree.Bits):
            return tree.Comparison(operand, "!=", tree.Constant(0))
        if field.kind is not Kind.TRUTH:
            example = values.example(field)
            refuse_part(part, f"is {kind_of(field)}, not a condition: compare it, like {example}")
        return tree.Comparison(operand, "==", tree.Constant(True))

    def _comparison(self, left: Part, sign: Part, right: Part) -> tree.Node:
        one, other = self._fields(left, right)
        if one and other and one.kind is not Kind.TEXT and not sign.text.endswith("contains"):
            return self._two_fields(left, sign, right)
        if one:
            return self._with_value(left, sign, right)
        if other:
            return self._with_value(right, self._turned(sign, other), left)
        return self._refuse_constants(left, right)

    def _fields(self, left: Part, right: Part) -> tuple[Field | None, Field | None]:
        """The fields of both sides, None for a side that is the same in all rows.

        A word that names a value of the other side is one (`name == speed`). So is a word that is
        spelled like a value, and like a field in another case only, unless it is compared with a
        number (`Speed != OK`).
        """
        one, other = self._field(left), self._field(right)
        if one and values.named(right, one) is not None:
            return one, None
        if other and values.named(left, other) is not None:
            return None, other
        numbers = ("number", "range", "set")
        if right.kind not in numbers and values.only_a_value(self._protocol, left):
            one = None
        if left.kind not in numbers and values.only_a_value(self._protocol, right):
            other = None
        return one, other

    def _turned(self, sign: Part, field: Field) -> Part:
        """The sign of a comparison whose field stands on the right: `100 < speed`."""
        turned = _TURNED.get(sign.text)
        if sign.text.endswith("in") and "contains" in field.signs:
            turned = sign.text.replace("in", "contains")
        if turned is None:
            refuse(sign, f"the name stands before {sign.text}, like {values.example(field)}")
        return sign._replace(text=turned)

    def _two_fields(self, left: Part, sign: Part, right: Part) -> tree.Node:
        (operand, one), (with_operand, other) = self._operand(left), self._operand(right)
        if sign.text not in _TURNED or one.kind is other.kind is Kind.BYTES:
            refuse_part(right, f"is a name of the row, and {sign.text} takes values")
        if one.kind is not other.kind:
            kinds = f"{one.name} is {kind_of(one)}, {other.name} is {kind_of(other)}"
            refuse(right, f"{kinds}: these never meet")
        if one.words and other.words and not one.words.keys() & other.words.keys():
            refuse(right, f"{one.name} and {other.name} have no values in common: they never meet")
        if operand == with_operand:
            refuse(right, "both sides are the same")
        self._require_sign(one, sign)
        return tree.Comparison(operand, sign.text, with_operand)

    def _with_value(self, left: Part, sign: Part, right: Part) -> tree.Node:
        """A comparison of a field with what is the same in all rows."""
        operand, field = self._operand(left)
        self._require_sign(field, sign)
        if not sign.text.endswith("in"):
            if sign.text.endswith("contains"):
                return self._containing(operand, field, sign, right)
            return self._compared(operand, field, sign.text, right)
        if right.kind not in ("set", "range"):
            refuse(right, f"in takes a set like {{{shown(right)}}} or a range like 1..2")
        several = right.parts if right.kind == "set" else (right,)
        return _among(sign, operand, [self._element(operand, field, part) for part in several])

    def _compared(self, operand: tree.Operand, field: Field, sign: str, part: Part) -> tree.Node:
        """A comparison with a value. Raises FilterError if it can never hold."""
        found = values.value(self._protocol, part, field)
        if isinstance(found, Instant):
            return _at(sign, found)
        if isinstance(found, int | float):
            if field.kind is Kind.NUMBER and isinstance(found, float) and sign in ("==", "!="):
                refuse_part(part, f"is not whole, and {field.name} always is")
            values.require_possible(field, sign, found, part)
            match operand, sign:
                case tree.Bits(right=tree.Constant(value=int() as mask)), "==" | "!=":
                    if int(found) & ~mask:
                        refuse_part(part, f"has other bits than {mask}, so this never holds")
        return tree.Comparison(operand, sign, tree.Constant(found))

    def _element(self, operand: tree.Operand, field: Field, part: Part) -> tree.Node:
        """Whether it is one of a set: a value, a name of the row, or a range."""
        if part.kind == "range":
            return self._ranged(operand, field, part)
        if field.kind is Kind.CLOCK:
            example = "14:03:20..14:03:21"
            refuse(part, f"no row matches a moment exactly: write a range, like {example}")
        if self._field(part) is None or values.named(part, field) is not None:
            return self._compared(operand, field, "==", part)
        with_operand, other = self._operand(part)
        if other.kind is not field.kind:
            refuse_part(part, f"is {kind_of(other)}, and {field.name} is {kind_of(field)}")
        return tree.Comparison(operand, "==", with_operand)

    def _ranged(self, operand: tree.Operand, field: Field, part: Part) -> tree.Node:
        """Whether it is in a range; one of times of day goes over midnight if it ends before."""
        found: list[Any] = [values.value(self._protocol, end, field) for end in part.parts]
        low, high = found
        if any(isinstance(end, str | bytes | bool) for end in found):
            why = "which has no ranges: name each value"
            refuse(part, f"{field.name} is {kind_of(field)}, {why}")
        if field.kind is Kind.CLOCK and low.daily is not high.daily:
            refuse(part, "times of day and times with a date do not go together in one set")
        over = field.kind is Kind.CLOCK and low.daily and low > high
        if low > high and not over:
            refuse(part, f"the range ends at {shown(part.parts[1])}, before it begins")
        if field.kind is Kind.NUMBER and math.ceil(low) > high:
            refuse(part, f"no whole number is in this range, and {field.name} always is one")
        ends = zip((">=", "<="), part.parts, strict=True)
        return _joined(not over, (self._compared(operand, field, *end) for end in ends))

    def _containing(
        self, operand: tree.Operand, field: Field, sign: Part, right: Part
    ) -> tree.Node:
        if field.kind in (Kind.WORDS, Kind.BYTES):
            read = values.word if field.kind is Kind.WORDS else values.value
            found: Any = read(self._protocol, right, field)
            if not found:
                refuse(right, "contains takes at least one byte, like 11 or 11 ff")
            return tree.Comparison(operand, sign.text, tree.Constant(found))
        if right.kind not in values.TEXTS or not right.text:
            refuse_part(right, f"is not a text; write {field.name} contains 'text'")
        if field.kind is Kind.TEXT:
            return tree.Comparison(operand, sign.text, tree.Constant(right.text))
        same = folded(right.text)
        named = [value for word, value in field.words.items() if same in folded(word)]
        if not named:
            refuse_part(right, f"is in no {field.name}; there are {values.listed(field)}")
        # A row's word may be several, as of the flags of an answer.
        same_or_has = "contains" if field.kind is Kind.WORD else "=="
        return _among(
            sign,
            operand,
            [tree.Comparison(operand, same_or_has, tree.Constant(one)) for one in named],
        )

    # Operands

    def _field(self, part: Part) -> Field | None:
        """The field that a part asks the row for, None for what is the same in all rows."""
        if part.kind in ("compared", "and", "or", "not"):
            refuse(part, "a condition is not compared: join it with and, or, not")
        if part.kind == "word":
            return find(self._protocol, part.text)
        return self._operand(part)[1] if part.kind in ("item", "bits") else None

    def _operand(self, part: Part) -> tuple[tree.Operand, Field]:
        """What a part asks the row for, and as a field: its kind and its limits."""
        if part.kind == "item":
            return self._item(part)
        if part.kind == "bits":
            if part not in self._known:
                self._known[part] = self._bits(part)
            return self._known[part]
        field = self._field(part)
        assert field is not None
        return tree.Name(field.key), field

    def _item(self, part: Part) -> tuple[tree.Operand, Field]:
        of, index = part.parts
        _, field = self._operand(of)
        place, most = values.whole_number(index), self._protocol.data_lengths[-1]
        if place is None or place < 0:
            refuse_part(index, f"is not a position: {field.name}[0] is the first byte")
        if field.name == "data" and place >= most:
            last = f"the last byte that data can have is data[{most - 1}]"
            refuse_part(index, f"is not a position: {last}")
        byte = Field(shown(part), Kind.NUMBER, "a byte", low=0, high=255)
        return tree.Name(field.key, place), byte

    def _bits(self, part: Part) -> tuple[tree.Operand, Field]:
        name, (left, right) = shown(part), part.parts
        if self._field(left) is None:
            left, right = right, left
        if self._field(left) is None:
            self._refuse_value(left)
        operand, field = self._operand(left)
        for side in (left, right):
            whole = self._field(side)
            if whole is not None and (whole.kind is not Kind.NUMBER or "&" not in whole.signs):
                refuse_part(side, f"is {kind_of(whole)}, and & takes whole numbers")
        if self._field(right) is not None:
            both = tree.Bits(operand, self._operand(right)[0])
            return both, Field(name, Kind.NUMBER, "bits")
        mask = values.value(self._protocol, right, field)
        if not isinstance(mask, int) or mask < 0 or mask.bit_length() > 63:
            refuse_part(right, "is not a mask; & takes a whole number like 4 or 0x80")
        reach = mask
        if field.low is not None and field.high is not None and field.low >= 0:
            reach = mask & ((1 << field.high.bit_length()) - 1)
        if not reach:
            refuse(right, f"{field.name} is {field.low} to {field.high}, so it has no such bit")
        bits = Field(name, Kind.NUMBER, "bits", low=0, high=reach)
        return tree.Bits(operand, tree.Constant(mask)), bits

    # What is a mistake

    def _require_sign(self, field: Field, sign: Part) -> None:
        text = sign.text.removeprefix("not ")
        if text in field.signs:
            return
        why = "which has no order: use == or !="
        if field.kind is Kind.CLOCK:
            why = "which no row matches exactly: write time in 14:03:20..14:03:21"
        elif text == "contains":
            why = "which contains nothing: contains is for names, text, bytes and faults"
        elif text == "in":
            why = f"so write {values.example(field)}"
        refuse(sign, f"{field.name} is {kind_of(field)}, {why}")

    def _refuse_value(self, part: Part) -> NoReturn:
        """Refuse a value that stands where a condition should. Raises FilterError."""
        if part.kind == "word":
            names = owners(self._protocol, part.text)
            if not names:
                values.refuse_unknown(self._protocol, part)
            refuse_part(part, f"is a value, not a condition: write {names[0]} == {shown(part)}")
        refuse_part(part, "asks nothing of the row: compare it with a name, like latency > 20ms")

    def _refuse_constants(self, left: Part, right: Part) -> NoReturn:
        """Refuse a comparison that asks nothing of the row. Raises FilterError."""
        meant = ""
        for part in (right, left):
            if part.kind == "word":
                names = owners(self._protocol, part.text)
                if not names:
                    values.refuse_unknown(self._protocol, part)
                meant = f", did you mean {names[0]} == {shown(part)}?"
        sentence = f"two values are compared, which is the same for all rows{meant}"
        raise FilterError(sentence, left.start, right.end)


def _joined(every: bool, nodes: Iterable[tree.Node]) -> tree.Node:
    """Conditions of which all must hold, or at least one."""
    listed = tuple(nodes)
    return listed[0] if len(listed) == 1 else tree.Joined(every, listed)


def _among(sign: Part, operand: tree.Operand, elements: Sequence[tree.Node]) -> tree.Node:
    """Whether a value is one of these, or (behind `not`) there is one and it is none of them."""
    among = _joined(False, elements)
    if not sign.text.startswith("not"):
        return among
    # Only a value is the same as itself: a row that lacks it passes no comparison.
    return tree.Joined(True, (tree.Comparison(operand, "==", operand), tree.Not(among)))


def _at(sign: str, moment: Instant) -> tree.Node:
    """A comparison with the clock."""
    key = tree.TIME_OF_DAY if moment.daily else tree.DATE
    return tree.Comparison(tree.Name(key), sign, tree.Constant(moment.ns))


_LATEST = 1 << 62  # ns since 1970; with a recording's length it still fits into 64 bits


@dataclass(frozen=True, slots=True)
class Filter:
    """A compiled filter.

    `start` is the wall clock (ns since 1970) at the recording's start. Where it is not known no row
    has a time of day, and no comparison with `time` holds.
    """

    tree: tree.Node
    protocol: Protocol
    start: int | None = None

    def started(self, start_wall: int) -> Filter:
        """The filter for a recording that began at this time (ns since 1970).

        A start that no clock shows (0 or less, or after the year 2116) counts as unknown.
        """
        return replace(self, start=start_wall if 0 < start_wall < _LATEST else None)

    def selection(self, batch: Batch) -> Selection:
        """Which rows of a batch pass."""
        from bilprov.analyzer.filters.masks import selection

        return selection(self.tree, self.protocol, batch, self.start)


def compile_filter(text: str, protocol: Protocol) -> Filter:
    """Compile a filter, which asks for rows of this protocol.

    The names are those of `fields_of(protocol)`. Raises FilterError, in one sentence that begins
    with the column.
    """
    return Filter(checked(parse(text, bytes_names(protocol)), protocol), protocol)
