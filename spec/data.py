"""The data of an instruction or an answer: fields in a row, of which the last may be counted."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from math import prod
from typing import Any, Literal, NamedTuple, TypeAlias

import msgspec
from construct import (
    Array,
    Bytes,
    Const,
    Construct,
    Container,
    Enum,
    FlagsEnum,
    FocusedSeq,
    GreedyBytes,
    GreedyRange,
    Prefixed,
    Renamed,
)
from msgspec.structs import replace

from bilprov.spec.errors import WrongValue, one_line, require_text, require_whole, require_word
from bilprov.spec.fields import Ranged, Reports
from bilprov.spec.numbers import Number, number_of

Value: TypeAlias = int | bytes | tuple[int, ...]
"""The value of a field: a number, bytes, or some numbers."""

Values: TypeAlias = Mapping[str, Value]

_MOST_FIELDS = 32  # of an instruction: the suite's frames grow with the square of their number
_MOST_BYTES = 1 << 16  # of a field

How = Literal["fixed", "bytes in front", "elements in front", "expression", "rest"]


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
            return self.constant is None or value == self.constant
        if isinstance(value, tuple):
            return all(self.in_range(one) for one in value)
        if self.names and value not in (known for _, known in self.names):
            return False
        if self.flags and value & ~self.mask:
            return False
        return self.low <= value <= self.high

    @property
    def unlimited(self) -> bool:
        """Whether any bytes are a value in the range."""
        form = self.many.element if self.many else self.number
        return self.constant is None and (form is None or self.count == 1 << 8 * form.size)

    @property
    def count(self) -> int:
        """How many values of a number are in the range."""
        if self.constant is not None:
            return 1
        if self.names:
            return len({value for _, value in self.names if self.low <= value <= self.high})
        if self.flags:
            return 1 << self.mask.bit_count()
        return self.high - self.low + 1

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
        mask = 0
        for _, flag in self.flags:
            mask |= flag
        return int(mask)


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
        context = Container({part.name: part.parse(_raw(part, begun)) for part in self.fields[:-1]})
        context["_params"] = Container(asked=Container(asked or {}))
        try:
            count = int(many.expression(context))
        except (KeyError, AttributeError, TypeError, ArithmeticError):
            return self.length
        return self.length + max(0, count) * many.width

    def decode(self, data: bytes) -> dict[str, Any]:
        """The value of each field with a name, in data that have all of them."""
        return {
            part.name: part.parse(self.raw(part, data))
            for part in self.fields
            if part.constant is None
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
        return data[part.offset :] if self.counted and part is self.fields[-1] else _raw(part, data)


def _raw(part: FieldSpec, data: bytes) -> bytes:
    return data[part.offset : part.offset + part.size]


def unwrapped(declared: Construct) -> Construct:
    """The construct within its names and prose."""
    while isinstance(declared, Renamed):
        declared = declared.subcon
    return declared


def prose_of(declared: Construct) -> str:
    """What a declaration is said to be (`* "prose"`), "" if nothing is."""
    return declared.docs if isinstance(declared, Renamed) else ""


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
        offset = sum(part.size for part in fields)
        one = _field(owner, member, offset)
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
    if not isinstance(declared, Renamed):
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
    context = Container(dict.fromkeys(own, 1))
    context["_params"] = Container(asked=Container(dict.fromkeys(asked, 1)))
    try:
        int(expression(context))
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
    if isinstance(body, Const):
        raw = body.build(None)
        require_whole(f"the size of a constant of {owner} in bytes", len(raw), 1, 255)
        return FieldSpec(member.name or "", prose_of(member), offset, len(raw), constant=raw)
    if member.name is None:
        raise WrongValue(f'a field of {owner} has no name; write it "name" / type')
    require_word(f"the name of a field of {owner}", member.name)
    name = f"{owner}.{member.name}"
    require_text(f"the prose of {name}", prose_of(member))
    many = _many(name, body)
    field = FieldSpec(member.name, prose_of(member), offset, 0, 0, 255)
    if many:
        allowed = _allowed(name, _element(body), many.element) if many.element else {}
        return replace(field, size=many.least, many=many, **allowed)
    reports = None
    if isinstance(body, Reports):
        reports = Reported(body.variable, body.factor, body.plus)
        body = unwrapped(body.subcon)
    number = _number(name, body, ", or Bytes, Array, Prefixed or PrefixedArray")
    allowed = _allowed(name, body, number)
    return replace(field, size=number.size, number=number, reports=reports, **allowed)


def _number(name: str, declared: Construct, others: str = "") -> Number:
    """The number within a range and names."""
    body = unwrapped(declared)
    while isinstance(body, Ranged | Enum | FlagsEnum):
        body = unwrapped(body.subcon)
    return number_of(body, name, others)


def _allowed(name: str, declared: Construct, number: Number) -> dict[str, Any]:
    """What a number may be, as attributes of its FieldSpec: its range, its names, its flags."""
    body = unwrapped(declared)
    ranged = body if isinstance(body, Ranged) else None
    inner = unwrapped(ranged.subcon) if ranged else body
    names: tuple[tuple[str, int], ...] = ()
    if isinstance(inner, Enum):
        names = tuple((str(name), int(value)) for name, value in inner.encmapping.items())
    flags = tuple(inner.flags.items()) if isinstance(inner, FlagsEnum) else ()
    low, high = (ranged.low, ranged.high) if ranged else (number.low, number.high)
    if not number.low <= low <= high <= number.high:
        reach = f"from low to high within {number.low} to {number.high}"
        raise WrongValue(f"{name} has the range {low} to {high}, allowed is one {reach}")
    bits = ranged.bits if ranged else ""
    if len(bits) > 8 * number.size:
        raise WrongValue(f"{name} names {len(bits)} bits, it has {8 * number.size}")
    if names and not ranged:
        low, high = min(value for _, value in names), max(value for _, value in names)
    allowed = {"low": low, "high": high, "bits": bits, "names": names, "flags": flags}
    return allowed | ({"reading": ranged.reading, "code": ranged.code} if ranged else {})


def _element(body: Construct) -> Construct:
    """The type of one of the numbers of a field that has several."""
    if isinstance(body, Prefixed):
        return _element(unwrapped(body.subcon))
    return (unwrapped(body.subcons[1]) if isinstance(body, FocusedSeq) else body).subcon


def _many(name: str, body: Construct) -> Many | None:
    """How many elements a field has; None for a single number."""
    if body is GreedyBytes:
        return Many(None, "rest")
    if isinstance(body, GreedyRange):
        return Many(_number(name, body.subcon), "rest")
    if isinstance(body, Bytes):
        return _counted(name, None, body.length)
    if isinstance(body, Array):
        return _counted(name, _number(name, body.subcon), body.count)
    if isinstance(body, Prefixed):
        inner = _many(name, unwrapped(body.subcon))
        if inner is None or inner.how != "rest" or body.includelength:
            raise WrongValue(f"{name} must be written Prefixed(Byte, GreedyRange(Byte))")
        return Many(inner.element, "bytes in front", prefix=_prefix(name, body.lengthfield))
    if isinstance(body, FocusedSeq) and body.parsebuildfrom == "items":  # PrefixedArray
        count, items = (unwrapped(part) for part in body.subcons)
        element = _number(name, items.subcon)
        return Many(element, "elements in front", prefix=_prefix(name, count.subcon))
    return None


def _prefix(name: str, declared: Construct) -> Number:
    number = number_of(unwrapped(declared), f"the count of {name}")
    if number.signed or number.size > 4:
        raise WrongValue(f"the count of {name} must be an unsigned number of at most 4 bytes")
    return number


def _counted(name: str, element: Number | None, count: Any) -> Many:
    if callable(count):
        return Many(element, "expression", expression=count)
    require_whole(f"the count of {name}", count, 1, _MOST_BYTES)
    return Many(element, "fixed", fixed=int(count))


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
