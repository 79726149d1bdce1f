"""Compiles filter expressions (`--filter EXPR`) and asks which rows of a batch pass.

A parsed filter is checked against a protocol, and turned into a tree of plain values, whose meaning
for rows stands in `masks`. A value that a name can never have is a mistake: the error says what was
meant. A row that lacks a value passes no comparison with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NoReturn

from bilprov.analyzer.filters import tree, values
from bilprov.analyzer.filters.fields import Field, Kind, by_folded, bytes_names, find, folded
from bilprov.analyzer.filters.syntax import Part, parse
from bilprov.analyzer.filters.values import Instant, kind_of, owners, refuse, refuse_part, shown
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch, Selection


_TURNED = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "==": "==", "!=": "!="}
_TURNED |= {"in": "contains", "not in": "not contains"}


class _Checker:
    """Checks the parts of one filter."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol

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
        if self._field(part) is None:
            self._refuse_value(part)
        operand, field = self._operand(part)
        if isinstance(operand, tree.Bits):
            return tree.Comparison(operand, "!=", tree.Constant(0))
        if field.kind is not Kind.TRUTH:
            example = values.example(field)
            refuse_part(part, f"is {kind_of(field)}, not a condition: compare it, like {example}")
        return tree.Comparison(operand, "==", tree.Constant(True))

    def _comparison(self, left: Part, sign: Part, right: Part) -> tree.Node:
        left, right = self._beside(left, right), self._beside(right, left)
        one, other = self._field(left), self._field(right)
        # A word that names a value of the other side is one: `name == speed`.
        if one and values.named(right, one) is not None:
            other = None
        elif other and values.named(left, other) is not None:
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
        if part.kind == "word" and numbers and find(self._protocol, part.text) is None:
            field = by_folded(self._protocol).get(folded(part.text))
            return part._replace(text=field.name) if field else part
        return part

    def _two_fields(self, left: Part, sign: Part, right: Part) -> tree.Node:
        (operand, one), (with_operand, other) = self._operand(left), self._operand(right)
        self._require_sign(one, sign)
        if sign.text.endswith("in") or one.kind is other.kind is Kind.BYTES:
            refuse_part(right, f"is a name of the row, and {sign.text} takes values")
        if one.kind is not other.kind:
            kinds = f"{one.name} is {kind_of(one)}, {other.name} is {kind_of(other)}"
            refuse(right, f"{kinds}: these never meet")
        if operand == with_operand:
            refuse(right, "both sides are the same")
        return tree.Comparison(operand, sign.text, with_operand)

    def _with_value(self, left: Part, sign: Part, right: Part) -> tree.Node:
        """A comparison of a field with what is the same in all rows."""
        operand, field = self._operand(left)
        self._require_sign(field, sign)
        if sign.text.endswith("contains"):
            return self._containing(operand, field, sign, right)
        if not sign.text.endswith("in"):
            return self._compared(operand, field, sign.text, right)
        if right.kind not in ("set", "range"):
            refuse(right, f"in takes a set like {{{shown(right)}}} or a range like 1..2")
        several = right.parts if right.kind == "set" else (right,)
        return _among(sign, operand, [self._element(operand, field, part) for part in several])

    def _compared(self, operand: tree.Operand, field: Field, sign: str, part: Part) -> tree.Node:
        """A comparison with a value. Raises FilterError if it can never hold."""
        found = values.value(self._protocol, part, field)
        if isinstance(found, Instant):
            key = tree.TIME_OF_DAY if found.daily else tree.DATE
            return tree.Comparison(tree.Name(key), sign, tree.Constant(found.ns))
        if isinstance(found, int | float):
            values.require_possible(field, sign, found, part)
        return tree.Comparison(operand, sign, tree.Constant(found))

    def _element(self, operand: tree.Operand, field: Field, part: Part) -> tree.Node:
        """Whether it is one of a set: a value, or in a range of them."""
        if part.kind != "range":
            if field.kind is Kind.CLOCK:
                refuse(part, "no row matches a moment exactly: write 14:03:20..14:03:21")
            return self._compared(operand, field, "==", part)
        low, high = (values.value(self._protocol, end, field) for end in part.parts)
        if isinstance(low, Instant) and isinstance(high, Instant):
            over_midnight = low.daily and high < low
            ordered = low.daily is high.daily and (low <= high or over_midnight)
        elif isinstance(low, int | float) and isinstance(high, int | float):
            over_midnight, ordered = False, low <= high
        else:
            refuse(part, f"{field.name} is {kind_of(field)}, which has no ranges: name each value")
        if not ordered:
            refuse(part, f"the range ends at {shown(part.parts[1])}, before it begins")
        ends = zip((">=", "<="), part.parts, strict=True)
        return _joined(not over_midnight, (self._compared(operand, field, *end) for end in ends))

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

    def _operand(self, part: Part) -> tuple[tree.Name | tree.Bits, Field]:
        """What a part asks the row for, and as a field: its kind and its limits."""
        if part.kind == "item":
            of, index = part.parts
            _, field = self._operand(of)
            place = values.whole_number(index)
            if place is None or place < 0:
                refuse_part(index, f"is not a position: {field.name}[0] is the first byte")
            byte = Field(shown(part), Kind.NUMBER, "a byte", low=0, high=255)
            return tree.Name(field.key, place), byte
        if part.kind == "bits":
            return self._bits(part)
        found = self._field(part)
        if found is None:
            self._refuse_value(part)
        return tree.Name(found.key), found

    def _bits(self, part: Part) -> tuple[tree.Bits, Field]:
        left, right = part.parts
        operand, field = self._operand(left)
        if field.kind is not Kind.NUMBER or "&" not in field.signs:
            refuse_part(left, f"is {kind_of(field)}, and & takes whole numbers")
        mask = values.value(self._protocol, right, field)
        if not isinstance(mask, int) or not 0 < mask < 1 << 63:
            refuse_part(right, "is not a mask; & takes a whole number like 4 or 0x80")
        assert isinstance(operand, tree.Name)
        return tree.Bits(operand, mask), Field(shown(part), Kind.NUMBER, "bits", low=0, high=mask)

    # What is a mistake

    def _require_sign(self, field: Field, sign: Part) -> None:
        text = sign.text.removeprefix("not ")
        if text not in field.signs:
            known = values.example(field)
            refuse(sign, f"{field.name} is {kind_of(field)}, without {text}: write {known}")

    def _refuse_value(self, part: Part) -> NoReturn:
        """Refuse a value that stands where a name should. Raises FilterError."""
        if part.kind == "word":
            names = owners(self._protocol, part.text)
            if not names:
                values.refuse_unknown(self._protocol, part)
            refuse_part(part, f"is a value, not a condition: write {names[0]} == {shown(part)}")
        refuse_part(part, "asks nothing of the row: compare a name with it, like latency > 20ms")


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
    tree_of = _Checker(protocol).condition(parse(text, bytes_names(protocol)))
    return Filter(tree_of, protocol)
