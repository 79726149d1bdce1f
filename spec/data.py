"""The data of an instruction or an answer: fields in a row, of which the last may be counted."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import reduce
from math import prod
from operator import or_
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias

import construct
import msgspec
from construct import Construct

from bilprov.spec.errors import WrongValue, one_line, require, require_word
from bilprov.spec.fields import Ranged, Reports

Value: TypeAlias = int | bytes | tuple[int, ...]
"""The value of a field: a number, bytes, or some numbers."""

Values: TypeAlias = Mapping[str, Value]

_MOST_FIELDS = 32  # of an instruction: the suite's frames grow with the square of their number
_MOST_BYTES = 1 << 16  # of a field

Order = Literal["big", "little"]
_NATIVE: Order = "little" if construct.Int16un.build(1)[0] else "big"

How = Literal["fixed", "bytes in front", "elements in front", "expression", "rest"]


class Number(msgspec.Struct, frozen=True):
    """A whole number of `size` bytes in a byte order, with two's complement if it is signed."""

    size: int
    order: Order
    signed: bool

    @property
    def low(self) -> int:
        """The lowest number there is."""
        return -(1 << 8 * self.size - 1) if self.signed else 0

    @property
    def high(self) -> int:
        """The highest number there is."""
        return (1 << 8 * self.size - self.signed) - 1

    def parse(self, data: bytes) -> int:
        """The number in these bytes, which are `size` many."""
        return int.from_bytes(data, self.order, signed=self.signed)

    def build(self, value: int) -> bytes:
        """The bytes of a number. Raises OverflowError for one that does not fit."""
        return value.to_bytes(self.size, self.order, signed=self.signed)


class Many(msgspec.Struct, frozen=True):
    """How many elements a field has: numbers, or bytes where `element` is None.

    `how` says what counts them: `fixed` elements; the number `prefix` in front, in bytes or in
    elements; an `expression` over the fields before it (and those of the request); or the frame.
    """

    element: Number | None
    how: How
    fixed: int = 0
    prefix: Number | None = None
    expression: Callable[[Any], int] | None = None

    @property
    def width(self) -> int:
        """The bytes of one element."""
        return self.element.size if self.element else 1

    @property
    def least(self) -> int:
        """The bytes that the field has in any case."""
        return self.fixed * self.width + (self.prefix.size if self.prefix else 0)

    def whole(self, raw: bytes) -> bool:
        """Whether the field's bytes are as many as its elements take."""
        return (len(raw) - (self.prefix.size if self.prefix else 0)) % self.width == 0

    def parse(self, raw: bytes) -> Value:
        """The value in the field's bytes, which may end with a part of an element."""
        data = raw[self.prefix.size :] if self.prefix else raw
        if self.element is None:
            return data
        width, parse = self.element.size, self.element.parse
        return tuple(parse(data[at : at + width]) for at in range(0, len(data) - width + 1, width))

    def build(self, value: Any) -> bytes:
        """The field's bytes. Raises ValueError, TypeError or OverflowError for a wrong value."""
        if self.element is None:
            if isinstance(value, int):  # of which bytes() makes so many zeros
                raise TypeError("one number is given")
            data = bytes.fromhex(value) if isinstance(value, str) else bytes(value)
        else:
            data = b"".join(self.element.build(one) for one in value)
        if self.how == "fixed" and len(data) != self.least:
            raise ValueError(f"{self.fixed} are needed, {len(data) // self.width} were given")
        if self.prefix:
            count = len(data) // (self.width if self.how == "elements in front" else 1)
            return self.prefix.build(count) + data
        return data


class Reported(NamedTuple):
    """The variable that a field tells: its value times `factor` plus `plus`, or by its name."""

    variable: str
    factor: int
    plus: int

    def value(self, of: str | int, names: tuple[tuple[str, int], ...]) -> int | None:
        """What tells this value of the variable, None for a word that is no name of a value."""
        return dict(names).get(of) if isinstance(of, str) else of * self.factor + self.plus


class FieldSpec(msgspec.Struct, frozen=True):
    """One data field: its place in the data (bytes), its range, and the names of its bits.

    `reading` is the reading by which a value out of the range is bad data, "" if the document says
    it, and `code` the name of the answer that it gets, "" for that of any bad data. `names` are
    named values (no other is in the range), `flags` named masks. A field with `constant` bytes has
    no value of its own. `many` is set for a field of bytes or of several numbers; `size` then
    counts the bytes that it has in any case. `number` is how a single number is written. `reports`
    is the variable of the state that a field of an answer tells.
    """

    name: str
    prose: str
    offset: int
    size: int
    low: int = 0
    high: int = 0
    bits: str = ""
    reading: str = ""
    code: str = ""
    names: tuple[tuple[str, int], ...] = ()
    flags: tuple[tuple[str, int], ...] = ()
    constant: bytes | None = None
    many: Many | None = None
    number: Number | None = None
    reports: Reported | None = None

    def parse(self, raw: bytes) -> Any:
        """The value in the field's bytes."""
        form = self.many or self.number
        return form.parse(raw) if form else raw

    def build(self, value: Any) -> bytes:
        """The field's bytes. Raises ValueError, TypeError or OverflowError for a wrong value."""
        form = self.many or self.number
        return form.build(value) if form else bytes(value)

    def named(self, value: Any) -> Any:
        """The name of a value, and the value itself where it has none; of several values each."""
        if isinstance(value, tuple):
            return tuple(map(self.named, value))
        return next((name for name, known in self.names if known == value), value)

    def in_words(self, value: Any) -> Any:
        """The same, and of flags the names of those that are set."""
        if isinstance(value, tuple):
            return tuple(map(self.in_words, value))
        return self.flags_in(value) if self.flags else self.named(value)

    def flags_in(self, value: int) -> tuple[str, ...]:
        """The names of the flags that are set in a value."""
        return tuple(name for name, mask in self.flags if value & mask == mask)

    def in_range(self, value: Value) -> bool:
        """Whether a value is in the range; that of several numbers is the range of each."""
        if isinstance(value, bytes):
            return self.constant in (None, value)
        if isinstance(value, tuple):
            return all(map(self.in_range, value))
        if self.names and value not in (known for _, known in self.names):
            return False
        if self.flags and value & ~self.mask:
            return False
        return self.low <= value <= self.high

    @property
    def element(self) -> Number | None:
        """How its number, or each of several, is written; None for bytes."""
        return self.many.element if self.many else self.number

    @property
    def unlimited(self) -> bool:
        """Whether any bytes are a value in the range."""
        every = self.element is None or self.count == 1 << 8 * self.element.size
        return self.constant is None and every

    @property
    def count(self) -> int:
        """How many values of a number are in the range."""
        if self.constant is not None:
            return 1
        if self.names:
            return len({value for _, value in self.names if self.low <= value <= self.high})
        return 1 << self.mask.bit_count() if self.flags else self.high - self.low + 1

    @property
    def allowed(self) -> str:
        """The range in words."""
        if self.constant is not None:
            return self.constant.hex(" ")
        if self.names:
            return ", ".join(f"{value} ({name})" for name, value in self.names)
        if self.flags:
            return "sums of " + ", ".join(f"{mask} ({name})" for name, mask in self.flags)
        return f"{self.low} to {self.high}"

    @property
    def allowed_in_short(self) -> str:
        """The range as one word: `0..7`, `off|on`, `HEX` for bytes, `N,N` for several numbers."""
        if self.many and self.unlimited:
            return "N,N" if self.many.element else "HEX"
        one = f"{self.low}..{self.high}"
        if self.names:
            one = "|".join(name for name, _ in self.names)
        elif self.flags:
            one = f"0..{self.mask}"
        return f"{one},{one}" if self.many else one

    @property
    def mask(self) -> int:
        """The bits of all its flags."""
        return reduce(or_, (flag for _, flag in self.flags), 0)


class DataSpec(msgspec.Struct, frozen=True):
    """Some fields one behind the other; `length` is the bytes that they have in any case."""

    fields: tuple[FieldSpec, ...] = ()
    length: int = 0

    @property
    def numbers(self) -> tuple[str, ...]:
        """The names of the fields that are one number each."""
        return tuple(part.name for part in self.fields if part.number)

    @property
    def counted(self) -> Many | None:
        """How the last field is counted; None where all data have the same length."""
        last = self.fields[-1].many if self.fields else None
        return last if last and last.how != "fixed" else None

    @property
    def takes_rest(self) -> bool:
        """Whether the last field takes what is left of the frame."""
        return self.counted is not None and self.counted.how == "rest"

    @property
    def valid_count(self) -> int:
        """How many valid data there are, of those with the least length."""
        return prod(part.count for part in self.fields if not part.many)

    def measure(self, begun: bytes, asked: Values | None = None) -> int | None:
        """How many bytes data have that begin so; None if that is not known yet.

        `asked` are the parts and the fields of the request where these are an answer's data. A
        last field that the frame delimits (`rest`) counts as none.
        """
        many = self.counted
        if many is None or many.how == "rest":
            return self.length
        if len(begun) < self.length:
            return None
        if many.prefix:
            at = self.fields[-1].offset
            count = many.prefix.parse(begun[at : at + many.prefix.size])
            return self.length + count * (1 if many.how == "bytes in front" else many.width)
        assert many.expression is not None
        values = {part.name: part.parse(self.raw(part, begun)) for part in self.fields[:-1]}
        try:
            count = int(many.expression(context_of(values, asked or {})))
        except (KeyError, AttributeError, TypeError, ArithmeticError):
            return self.length
        return self.length + max(0, count) * many.width

    def decode(self, data: bytes) -> dict[str, Any]:
        """The value of each field with a name, in data that have all of them."""
        return {
            one.name: one.parse(self.raw(one, data)) for one in self.fields if one.constant is None
        }

    def wrong(self, data: bytes) -> FieldSpec | None:
        """The first field whose value is out of its range; None if there is none."""
        for part in self.fields:
            raw = self.raw(part, data)
            if part.many and not part.many.whole(raw):
                return part
            if not part.in_range(raw if part.constant is not None else part.parse(raw)):
                return part
        return None

    def raw(self, part: FieldSpec, data: bytes) -> bytes:
        """The bytes of a field; a counted one goes to the end of the data."""
        last = self.counted and part is self.fields[-1]
        return data[part.offset : None if last else part.offset + part.size]


def context_of(values: Mapping[str, Any], asked: Mapping[str, Any]) -> construct.Container:
    """What expressions like `this.size` and `asked.size` look into."""
    return construct.Container(
        values, _params=construct.Container(asked=construct.Container(asked))
    )


def unwrapped(declared: Construct) -> Construct:
    """The construct within its names and prose."""
    while isinstance(declared, construct.Renamed):
        declared = declared.subcon
    return declared


def prose_of(declared: Construct) -> str:
    """What a declaration is said to be (`* "prose"`), "" if nothing is."""
    return declared.docs if isinstance(declared, construct.Renamed) else ""


def read_data(
    owner: str, members: list[Construct], *, framed: bool, asked: Iterable[str] = ()
) -> DataSpec:
    """Read the fields of `owner`, an instruction or an answer. Raises WrongValue, in one sentence.

    `framed` says that the frame has a length, so that the last field may take what is left.
    `asked` names what an answer may be counted by: numbers of the request.
    """
    if len(members) > _MOST_FIELDS:
        raise WrongValue(f"{owner} has {len(members)} fields, allowed are {_MOST_FIELDS}")
    fields: list[FieldSpec] = []
    for place, member in enumerate(members):
        one = _field(owner, member, sum(part.size for part in fields))
        how = one.many.how if one.many else "fixed"
        if how != "fixed" and place < len(members) - 1:
            raise WrongValue(f"{owner}.{one.name} is counted; only the last field may be")
        if one.many and one.many.expression:
            _require_counted(f"{owner}.{one.name}", one.many.expression, fields, asked)
        if how == "rest" and not framed:
            raise WrongValue(
                f"{owner}.{one.name} takes the rest of a frame without a length; "
                "declare Bytes(n), or a count in front"
            )
        fields.append(one)
    names = [part.name.lower() for part in fields if part.name]
    for name in names:
        if names.count(name) > 1:
            raise WrongValue(
                f"{owner} has two fields named {name}; give one {owner}.{name} another name"
            )
    return DataSpec(tuple(fields), sum(part.size for part in fields))


def read_register(memory: str, declared: Any) -> FieldSpec:
    """Read a named cell of a memory, or some: one number. Raises WrongValue."""
    if not isinstance(declared, construct.Renamed):
        raise WrongValue(f'a register of {memory} must be written "name" / type')
    one = _field(f"REGISTERS of {memory}", declared, 0)
    if one.number is None:
        raise WrongValue(f"the register {one.name} of {memory} must be one number")
    return one


def _require_counted(
    name: str, expression: Callable[[Any], Any], before: list[FieldSpec], asked: Iterable[str]
) -> None:
    """Raise WrongValue for a count of what is no number before it, or in the request."""
    own = [part.name for part in before if part.number]
    try:
        int(expression(context_of(dict.fromkeys(own, 1), dict.fromkeys(asked, 1))))
    except ArithmeticError:  # it depends on the numbers, which are there
        return
    except Exception as error:
        allowed = [*(f"this.{one}" for one in own), *(f"asked.{one}" for one in asked)]
        raise WrongValue(
            f"{name} is counted by {one_line(error, 40)}; allowed are "
            f"{', '.join(allowed) or 'a number or Prefixed(Byte, ...)'}"
        ) from error


def _field(owner: str, member: Construct, offset: int) -> FieldSpec:
    body = unwrapped(member)
    prose = prose_of(member)
    require(f"the prose of {owner}.{member.name}", prose, str)
    if isinstance(body, construct.Const):
        raw = body.build(None)
        return FieldSpec(member.name or "", prose, offset, len(raw), constant=raw)
    if member.name is None:
        raise WrongValue(f'a field of {owner} has no name; write it "name" / type')
    require_word(f"the name of a field of {owner}", member.name)
    name = f"{owner}.{member.name}"
    reports = None
    if isinstance(body, Reports):
        reports = Reported(body.variable, body.factor, body.plus)
        body = unwrapped(body.subcon)
    counted, element = _counted(name, body)
    number, allowed = None, {"high": 255}
    if element:
        others = "" if counted else ", or Bytes, Array, Prefixed or PrefixedArray"
        number, allowed = _number(name, element, others)
    many = Many(number, **counted) if counted else None
    form: Any = {"many": many, "size": many.least} if many else {"number": number}
    return FieldSpec(
        member.name,
        prose,
        offset,
        **{"size": number.size if number else 0, "reports": reports, **form, **allowed},
    )


def _counted(name: str, body: Construct) -> tuple[dict[str, Any], Construct | None]:
    """How a field is counted, and what is: none for a single number, None for bytes."""
    if body is construct.GreedyBytes:
        return {"how": "rest"}, None
    if isinstance(body, construct.GreedyRange):
        return {"how": "rest"}, body.subcon
    if isinstance(body, construct.Bytes):
        return _count(name, body.length), None
    if isinstance(body, construct.Array):
        return _count(name, body.count), body.subcon
    if isinstance(body, construct.Prefixed):
        inner, element = _counted(name, unwrapped(body.subcon))
        if inner != {"how": "rest"} or body.includelength:
            raise WrongValue(f"{name} must be written Prefixed(Byte, GreedyRange(Byte))")
        return {"how": "bytes in front", "prefix": _prefix(name, body.lengthfield)}, element
    if isinstance(body, construct.FocusedSeq) and body.parsebuildfrom == "items":  # PrefixedArray
        count, items = (unwrapped(part) for part in body.subcons)
        return {"how": "elements in front", "prefix": _prefix(name, count.subcon)}, items.subcon
    return {}, body


def _count(name: str, count: Any) -> dict[str, Any]:
    if callable(count):
        return {"how": "expression", "expression": count}
    require(f"the count of {name}", count, Annotated[int, msgspec.Meta(ge=1, le=_MOST_BYTES)])
    return {"how": "fixed", "fixed": count}


def _prefix(name: str, declared: Construct) -> Number:
    number = number_of(unwrapped(declared), f"the count of {name}")
    if number.signed or number.size > 4:
        raise WrongValue(f"the count of {name} must be an unsigned number of at most 4 bytes")
    return number


def _number(name: str, declared: Construct, others: str) -> tuple[Number, dict[str, Any]]:
    """A number, and what it may be as attributes of its FieldSpec: its range, names and flags."""
    body = unwrapped(declared)
    ranged = body if isinstance(body, Ranged) else None
    inner = unwrapped(ranged.subcon) if ranged else body
    named = isinstance(inner, construct.Enum | construct.FlagsEnum)
    number = number_of(unwrapped(inner.subcon) if named else inner, name, others)
    allowed: dict[str, Any] = {}
    low, high = number.low, number.high
    if named:
        values = inner.encmapping if isinstance(inner, construct.Enum) else inner.flags
        for word, value in values.items():
            require(f"the value of {word} of {name}", value, int)
        if not values:
            raise WrongValue(f"{name} names no values; write them, or a number")
        names = tuple((str(word), int(value)) for word, value in values.items())
        allowed["names" if isinstance(inner, construct.Enum) else "flags"] = names
    if isinstance(inner, construct.Enum):
        low, high = min(inner.decmapping), max(inner.decmapping)
    if ranged:
        low, high = ranged.low, ranged.high
        allowed |= {"bits": ranged.bits, "reading": ranged.reading, "code": ranged.code}
        if len(ranged.bits) > 8 * number.size:
            raise WrongValue(f"{name} names {len(ranged.bits)} bits, it has {8 * number.size}")
    if not number.low <= low <= high <= number.high:
        raise WrongValue(
            f"{name} has the range {low} to {high}, allowed is one from low to high within "
            f"{number.low} to {number.high}"
        )
    return number, {"low": low, "high": high, **allowed}


def number_of(declared: Construct, what: str, others: str = "") -> Number:
    """Read a whole number of construct. Raises WrongValue for anything else.

    `others` names what else is allowed there.
    """
    if isinstance(declared, construct.BytesInteger):
        size, little = declared.length, declared.swapped
        if isinstance(size, int) and 0 < size < 256 and isinstance(little, bool):
            return Number(size, "little" if little else "big", bool(declared.signed))
    if isinstance(declared, construct.FormatField):
        order, kind = declared.fmtstr
        if kind in "BHLQbhlq":
            orders: dict[str, Order] = {"<": "little", ">": "big"}
            return Number(declared.length, orders.get(order, _NATIVE), kind.islower())
        bits = 8 * declared.length
        raise WrongValue(
            f"{what} is a floating-point number; declare its bits, Int{bits}ub or Int{bits}ul"
        )
    raise WrongValue(f"the type of {what} must be a whole number, such as Byte{others}")


def shown_value(part: FieldSpec, value: Value) -> str:
    """A value as people read it: `5`, `2 (safe)`, `01 ff`, `3 4 5`."""
    if isinstance(value, bytes):
        return value.hex(" ")
    if isinstance(value, tuple):
        return " ".join(shown_value(part, one) for one in value)
    name = part.named(value)
    if name != value:
        return f"{value} ({name})"
    return f"{value} ({' '.join(part.flags_in(value)) or 'none'})" if part.flags else str(value)


def plain_values(fields: Any) -> dict[str, Any]:
    """Fields by name as JSON holds them: bytes in hex, several numbers as a list."""
    return {name: value if isinstance(value, int) else plain_value(value) for name, value in fields}


def plain_value(value: Any) -> Any:
    """A value as JSON holds it."""
    if isinstance(value, bytes):
        return value.hex()
    return list(value) if isinstance(value, tuple) else value
