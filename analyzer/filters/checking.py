"""Checks a parsed filter against a protocol, and turns it into the tree that asks rows.

What can never hold, or asks nothing of a row, is a mistake: the error says what was meant.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NoReturn, TypeAlias

from bilprov.analyzer.filters import moments, tree, values
from bilprov.analyzer.filters.fields import Field, Kind, find, folded
from bilprov.analyzer.filters.parts import FilterError, Part
from bilprov.analyzer.filters.values import kind_of, owners, refuse, refuse_part, shown
from bilprov.spec.protocol import Protocol

_TURNED = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "==": "==", "!=": "!="}
_Ends: TypeAlias = tuple[tree.Operand, tree.Operand]


def checked(part: Part, protocol: Protocol) -> tree.Node:
    """The tree of a parsed filter. Raises FilterError."""
    return _Checker(protocol).condition(part)


class _Checker:
    """Checks the parts of one filter."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        # What was found out about each part with &: it is asked for several times.
        self._known: dict[int, tuple[tree.Operand, Field]] = {}

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
                nodes = tuple(map(self._comparison, operands, signs, operands[1:]))
                return nodes[0] if len(nodes) == 1 else tree.Joined(True, nodes)
        if self._field(part) is None or values.only_a_value(self._protocol, part):
            return self._refuse_value(part)
        operand, field = self._operand(part)
        if isinstance(operand, tree.Bits):
            return tree.Comparison(operand, "!=", tree.Constant(0))
        if field.kind is not Kind.TRUTH:
            example = values.example(field)
            refuse_part(part, f"is {kind_of(field)}, not a condition: compare it, like {example}")
        return tree.Comparison(operand, "==", tree.Constant(True))

    def _comparison(self, left: Part, sign: Part, right: Part) -> tree.Node:
        one, other = self._fields(left, right)
        if one and (one.kind is Kind.TEXT or sign.text.endswith("contains")):
            other = None  # any word is text there
        if one and other:
            return self._two_fields(left, sign, right)
        if one:
            return self._with_value(left, sign, right)
        if other:
            return self._turned(left, sign, right, other)
        return self._refuse_constants(left, right)

    def _fields(self, left: Part, right: Part) -> tuple[Field | None, Field | None]:
        """The fields of both sides, None for a side that is the same in all rows.

        A word that names a value of the other side is one (`name == speed`). So is a word that is
        spelled like a value, and like a field in another case only, unless it is compared with a
        number (`Speed != OK`).
        """
        one, other = self._field(left), self._field(right)
        if one and values.names_value(right, one):
            return one, None
        if other and values.names_value(left, other):
            return None, other
        numbers = ("number", "range", "set")
        if right.kind not in numbers and values.only_a_value(self._protocol, left):
            one = None
        if left.kind not in numbers and values.only_a_value(self._protocol, right):
            other = None
        return one, other

    def _turned(self, left: Part, sign: Part, right: Part, field: Field) -> tree.Node:
        """A comparison whose field stands on the right: `100 < speed`, `'LED' in reason`."""
        if sign.text in _TURNED:
            turned = _TURNED[sign.text]
        elif sign.text.endswith("in") and "contains" in field.signs:
            turned = sign.text.replace("in", "contains")
        else:
            refuse(sign, f"the name stands before {sign.text}, like {values.example(field)}")
        return self._with_value(right, sign._replace(text=turned), left)

    def _two_fields(self, left: Part, sign: Part, right: Part) -> tree.Node:
        (operand, one), (with_operand, other) = self._operand(left), self._operand(right)
        if sign.text not in _TURNED:
            refuse_part(right, f"is a name of the row, and {sign.text} takes values")
        if one.kind is not other.kind:
            kinds = f"{one.name} is {kind_of(one)}, {other.name} is {kind_of(other)}"
            refuse(right, f"{kinds}: these never meet")
        if one.words and other.words and one.words != other.words:
            refuse(right, f"{one.name} and {other.name} have no values in common: they never meet")
        if operand == with_operand:
            refuse(right, "both sides are the same")
        self._require_sign(one, sign)
        if one.kind not in (Kind.NUMBER, Kind.SECONDS, Kind.TRUTH, Kind.WORD):
            refuse_part(right, f"is a name of the row; {one.name} is compared with values")
        return tree.Comparison(operand, sign.text, with_operand)

    def _with_value(self, left: Part, sign: Part, right: Part) -> tree.Node:
        """A comparison of a field with what is the same in all rows."""
        operand, field = self._operand(left)
        self._require_sign(field, sign)
        if sign.text.endswith("contains"):
            return self._containing(field, right, sign.text == "contains")
        if sign.text.endswith("in"):
            return self._among(operand, field, right, sign.text == "in")
        if field.kind is Kind.WORDS:
            kinds = right.parts if right.kind == "set" else (right,)
            found = frozenset(str(values.word(self._protocol, kind, field)) for kind in kinds)
            return tree.Comparison(operand, sign.text, tree.Constant(found))
        if field.kind is Kind.CLOCK:
            moment = values.instant(right)
            return tree.Comparison(_clock(moment), sign.text, tree.Constant(moment.ns))
        found_value = values.value(self._protocol, right, field)
        if field.kind is Kind.NUMBER and isinstance(found_value, float):
            if sign.text in ("==", "!="):
                refuse_part(right, f"is not whole, and {field.name} always is")
            down = sign.text in ("<=", ">")
            found_value = math.floor(found_value) if down else math.ceil(found_value)
        _require_possible(operand, field, sign.text, found_value, right)
        return tree.Comparison(operand, sign.text, tree.Constant(found_value))

    def _among(self, operand: tree.Operand, field: Field, right: Part, holds: bool) -> tree.Node:
        if right.kind not in ("set", "range"):
            refuse(right, f"in takes a set like {{{shown(right)}}} or a range like 1..2")
        several = right.parts if right.kind == "set" else (right,)
        if field.kind is Kind.CLOCK:
            return self._among_moments(several, holds)
        return tree.Among(
            operand, tuple(self._ends(operand, field, part) for part in several), holds
        )

    def _ends(self, operand: tree.Operand, field: Field, part: Part) -> _Ends:
        """The ends of a range; those of a single value are the same."""
        if part.kind == "range":
            low, high = self._range_ends(part, field)
            return tree.Constant(low), tree.Constant(high)
        if self._field(part) is not None and not values.names_value(part, field):
            end, other = self._operand(part)
            if other.kind is not field.kind:
                refuse_part(part, f"is {kind_of(other)}, and {field.name} is {kind_of(field)}")
            return end, end
        found = values.value(self._protocol, part, field)
        if field.kind is Kind.NUMBER and isinstance(found, float):
            refuse_part(part, f"is not whole, and {field.name} always is")
        _require_possible(operand, field, "==", found, part)
        return tree.Constant(found), tree.Constant(found)

    def _range_ends(self, part: Part, field: Field) -> tuple[float, float]:
        low, high = (values.value(self._protocol, end, field) for end in part.parts)
        if isinstance(low, str | bytes | bool) or isinstance(high, str | bytes | bool):
            refuse(
                part,
                f"{field.name} is {kind_of(field)}, which has no ranges: name each value",
            )
        if low > high:
            refuse(part, f"the range ends at {shown(part.parts[1])}, before it begins")
        if field.kind is Kind.NUMBER:
            low, high = math.ceil(low), math.floor(high)
            if low > high:
                refuse(part, f"no whole number is in this range, and {field.name} always is one")
        values.require_possible(field, ">=", low, part.parts[0])
        values.require_possible(field, "<=", high, part.parts[1])
        return low, high

    def _among_moments(self, several: Sequence[Part], holds: bool) -> tree.Node:
        """Ranges of moments; of a day, one that ends before it begins goes over midnight."""
        ranges: list[tuple[moments.Instant, moments.Instant]] = []
        for part in several:
            if part.kind != "range":
                refuse(
                    part, "no row matches a moment exactly: write a range, like 14:03:20..14:03:21"
                )
            low, high = map(values.instant, part.parts)
            if len({low.daily, high.daily, *(first.daily for first, _ in ranges)}) > 1:
                refuse(part, "times of day and times with a date do not go together in one set")
            if low > high and not low.daily:
                refuse(part, f"the range ends at {shown(part.parts[1])}, before it begins")
            if low > high:
                ranges.append((low, moments.Instant(True, moments.DAY)))
                low = moments.Instant(True, 0)
            ranges.append((low, high))
        ends = tuple((tree.Constant(low.ns), tree.Constant(high.ns)) for low, high in ranges)
        return tree.Among(_clock(ranges[0][0]), ends, holds)

    def _containing(self, field: Field, right: Part, holds: bool) -> tree.Node:
        if field.kind is Kind.WORDS:
            return tree.Contains(field.key, str(values.word(self._protocol, right, field)), holds)
        if field.kind is Kind.BYTES:
            data = values.value(self._protocol, right, field)
            if not isinstance(data, bytes) or not data:
                refuse(right, "contains takes at least one byte, like 11 or 11 ff")
            return tree.Contains(field.key, data, holds)
        if right.kind not in values.TEXTS or not right.text:
            refuse_part(right, f"is not a text; write {field.name} contains 'text'")
        if field.kind is Kind.TEXT:
            return tree.Contains(field.key, right.text, holds)
        same = folded(right.text)
        found = [named for text, named in field.words.items() if same in folded(text)]
        if not found:
            refuse_part(right, f"is in no {field.name}; there are {values.listed(field)}")
        ends = tuple((tree.Constant(one), tree.Constant(one)) for one in found)
        return tree.Among(tree.Name(field.key), ends, holds)

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
            whole = self._operand(part.parts[0])[1]
            place = self._index(whole, part.parts[1])
            byte = Field(shown(part), Kind.NUMBER, "a byte", low=0, high=255)
            return tree.Item(whole.key, place), byte
        if part.kind == "bits":
            if id(part) not in self._known:
                left, right = part.parts
                if self._field(left) is None:
                    left, right = right, left
                self._known[id(part)] = self._bits(left, right, shown(part))
            return self._known[id(part)]
        field = self._field(part)
        assert field is not None
        return tree.Name(field.key), field

    def _index(self, field: Field, index: Part) -> int:
        place, most = values.whole_number(index), self._protocol.data_lengths[-1]
        if place is None or place < 0:
            refuse_part(index, f"is not a position: {field.name}[0] is the first byte")
        if field.name == "data" and place >= most:
            refuse_part(
                index, f"is not a position: the last byte that data can have is data[{most - 1}]"
            )
        return place

    def _bits(self, left: Part, right: Part, name: str) -> tuple[tree.Operand, Field]:
        if self._field(left) is None:
            self._refuse_value(left)
        operand, field = self._operand(left)
        for part in (left, right):
            whole = self._field(part)
            if whole is not None and whole.kind is not Kind.NUMBER:
                refuse_part(part, f"is {kind_of(whole)}, and & takes whole numbers")
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
        if field.kind is Kind.CLOCK:
            why = "which no row matches exactly: write time in 14:03:20..14:03:21"
        elif text == "contains":
            why = "which contains nothing: contains is for names, text, bytes and faults"
        elif text == "in":
            why = f"so write {values.example(field)}"
        else:
            why = "which has no order: use == or !="
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
        words = [part for part in (left, right) if part.kind == "word"]
        for part in words:
            if not owners(self._protocol, part.text):
                values.refuse_unknown(self._protocol, part)
        first = shown(words[0]) if words else ""
        meant = f", did you mean {owners(self._protocol, first)[0]} == {first}?" if words else ""
        sentence = f"two values are compared, which is the same for all rows{meant}"
        raise FilterError(sentence, left.start, right.end)


def _require_possible(
    operand: tree.Operand, field: Field, sign: str, found: float | str | bytes, part: Part
) -> None:
    """Refuse a value that the operand never has. Raises FilterError."""
    if isinstance(found, str | bytes):
        return
    values.require_possible(field, sign, found, part)
    match operand:
        case tree.Bits(right=tree.Constant(value=int() as mask)):
            if sign in ("==", "!=") and int(found) & ~mask:
                refuse_part(part, f"has other bits than {mask}, so this never holds")


def _clock(moment: moments.Instant) -> tree.Operand:
    return tree.Name(tree.TIME_OF_DAY if moment.daily else tree.DATE)
