"""Reads FRAME, REPLY and ERROR into layouts: where each part of a frame is, and where it ends.

A layout is a plain value; no module but this one and `data` meets a construct of a frame. What
cannot be read into a layout raises WrongValue.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from typing import Any, Literal

import msgspec
from construct import (
    BitsInteger,
    BitStruct,
    Checksum,
    Const,
    Construct,
    Container,
    FixedSized,
    RawCopy,
    Struct,
    Switch,
)
from msgspec.structs import replace

from bilprov.spec.checks import CheckFunction
from bilprov.spec.data import DataSpec, Values, prose_of, unwrapped
from bilprov.spec.errors import WrongValue, require_text, require_whole, require_word
from bilprov.spec.fields import Address, Answers, Data, Length, Same
from bilprov.spec.numbers import Number, number_of, path_of

Role = Literal["constant", "address", "id", "length", "code", "other", "check"]

_ROLES: dict[str, Role] = {"id": "id", "length": "length", "address": "address"}
_MOST_PARTS = 32
_MOST_DATA = 1 << 20  # bytes of data that a frame may announce; more is no frame
_ASKED = b"\x01asked"
_HERE = b"\x02here"


class Part(msgspec.Struct, frozen=True):
    """One part of a frame besides its data.

    `offset` is from the frame's first byte, or from behind its last where it is negative: then the
    part is behind the data. A part of a byte of bits has its `width` in bits and is `shift` bits
    above the lowest one; otherwise `width` is 0. `same` names the part of the request that it
    repeats, with `plus` added. `low`, `high` and `broadcast` are those of an address. A constant of
    whole bytes has them in `constant`, one of some bits is `low`.
    """

    name: str
    prose: str
    role: Role
    offset: int
    number: Number
    width: int = 0
    shift: int = 0
    constant: bytes = b""
    also: int = 0
    same: str = ""
    plus: int = 0
    low: int = 0
    high: int = 0
    broadcast: int | None = None

    def reaches(self, address: object) -> bool:
        """Whether what is sent to an address is for a device that there can be, or for all."""
        return isinstance(address, int) and (
            self.low <= address <= self.high or address == self.broadcast
        )

    @property
    def allowed(self) -> str:
        """The range in words, like `1 to 247, and 0 for all`."""
        everybody = "" if self.broadcast is None else f", and {self.broadcast} for all"
        return f"{self.low} to {self.high}{everybody}"

    @property
    def allowed_in_short(self) -> str:
        """The range as one word, like `1..247`."""
        return f"{self.low}..{self.high}"

    @property
    def size(self) -> int:
        """Its bytes, or those of the byte of bits that it is in."""
        return self.number.size

    def raw(self, frame: bytes) -> bytes:
        """Its bytes in a frame."""
        return frame[self.offset : self.offset + self.size or None]

    def read(self, frame: bytes) -> int:
        """Its value in a frame; a length is the number of data bytes."""
        value = self.number.parse(self.raw(frame))
        if self.width:
            value = value >> self.shift & (1 << self.width) - 1
        return value - self.also

    @property
    def most(self) -> int:
        """The largest value that it can have."""
        return ((1 << self.width) - 1 if self.width else self.number.high) - self.also

    def repeating(self, value: Any) -> Any:
        """The value with which it repeats one of the request, cut to the part's bits.

        Both are numbers or arrays of them.
        """
        return (value + self.plus) & self.most

    def repeated(self, value: Any) -> Any:
        """The value of the request that it repeats by this one, a number or an array of them."""
        return (value - self.plus) & self.most


class Check(msgspec.Struct, frozen=True):
    """The check of a frame: its place, its function, and what it counts.

    It covers the bytes from `first` on, as far as `last` bytes before the frame's end; with `asked`
    what the request's check covers stands before them.
    """

    part: Part
    function: CheckFunction
    first: int
    last: int
    asked: bool = False

    def due(self, frame: bytes, asked: bytes = b"") -> int:
        """The right value in a frame; `asked` is what the request's check covers."""
        covered = self.covered(frame)
        return self.function(asked + covered if self.asked else covered)

    def right_sizes(self, begun: bytes, least: int, asked: bytes = b"") -> Iterator[int]:
        """The sizes, `least` or more, that a frame which begins so can have: it is right there.

        Each byte is counted once, however many sizes are tried. `asked` is what the request's
        check covers.
        """
        part, before = self.part, asked if self.asked else b""
        values = self.function.running(before + self.covered(begun))
        for size, value in enumerate(values, self.first + self.last - len(before)):
            at = size + part.offset
            if size >= least and part.number.parse(begun[at : at + part.size]) == value:
                yield size

    def covered(self, frame: bytes) -> bytes:
        """The bytes of a frame that it counts."""
        return frame[self.first : len(frame) - self.last]

    def holds(self, frame: bytes, asked: bytes = b"") -> bool:
        """Whether the value in a frame is the right one."""
        return self.part.read(frame) == self.due(frame, asked)

    def right(self, frame: bytes, asked: bytes = b"") -> bytes:
        """The bytes that it must have in a frame."""
        return self.part.number.build(self.due(frame, asked))

    def wrong(self, frame: bytes, asked: bytes = b"") -> str:
        """What is wrong with it in a frame, in words; "" where it is right."""
        found, right = self.part.raw(frame), self.right(frame, asked)
        if found == right:
            return ""
        return f"{self.part.name} is {found.hex(' ')}, right is {right.hex(' ')}"


class Layout(msgspec.Struct, frozen=True, dict=True):
    """The parts of a frame in order: `head` bytes, the data, `tail` bytes.

    `has_data` is false for an answer without a place for data. `covered` names the parts that a
    check of the answer may count too: `asked.covered.data`.
    """

    parts: tuple[Part, ...]
    head: int
    tail: int
    check: Check | None
    has_data: bool
    covered: tuple[str, ...] = ()

    def part(self, role: Role) -> Part | None:
        """The part of that role; None if there is none."""
        return self._by_role.get(role)

    @cached_property
    def _by_role(self) -> Mapping[Role, Part]:
        return {part.role: part for part in reversed(self.parts)}

    @cached_property
    def sync(self) -> bytes:
        """The constant bytes in front."""
        found = b""
        for part in self.parts:
            if part.role != "constant" or part.offset != len(found):
                break
            found += part.constant
        return found

    @cached_property
    def constants(self) -> tuple[tuple[int, bytes], ...]:
        """The offset and the bytes of each constant of whole bytes."""
        return tuple((part.offset, part.constant) for part in self.parts if part.constant)

    @cached_property
    def fixed_bits(self) -> tuple[Part, ...]:
        """The constants of some bits."""
        return tuple(part for part in self.parts if part.role == "constant" and part.width)

    def value(self, role: Role, frame: bytes) -> int | None:
        """The value of the part of that role in a frame; None where it has no such part."""
        part = self._by_role.get(role)
        return part.read(frame) if part else None

    def data_of(self, frame: bytes) -> bytes:
        """The data in a whole frame."""
        return frame[self.head : len(frame) - self.tail]

    def begins(self, held: bytes) -> bool:
        """Whether bytes may begin a frame: the constants in front that are there are right."""
        right = all(
            held[offset : offset + len(raw)] == raw[: max(0, len(held) - offset)]
            for offset, raw in self.constants
            if 0 <= offset < len(held)
        )
        return right and not any(
            part.read(held) != part.low
            for part in self.fixed_bits
            if 0 <= part.offset <= len(held) - part.size
        )

    def wrong_constant(self, frame: bytes) -> str:
        """What is wrong with the first wrong constant in a whole frame; "" if all are right."""
        for offset, raw in self.constants:
            found = frame[offset : offset + len(raw) or None]
            if found != raw:
                return f"{found.hex(' ')} stands where {raw.hex(' ')} must be"
        for part in self.fixed_bits:
            if part.read(frame) != part.low:
                return f"{part.name or 'a constant'} is {part.read(frame)}, right is {part.low}"
        return ""

    def unrepeated(self, held: bytes, asked: Values) -> tuple[Part, int] | None:
        """The first part that does not repeat the request's, and its right value.

        Only the parts count that are within the bytes; None if all of these do.
        """
        for part in self.parts:
            if part.same and part.offset >= 0 and part.offset + part.size <= len(held):
                right = part.repeating(asked.get(part.same, -1))
                if part.same not in asked or part.read(held) != right:
                    return part, right
        return None

    def may_repeat(self, held: bytes) -> bool:
        """Whether the parts that repeat some request's can, as far as the bytes go."""
        return all(
            part.read(held) >= part.plus
            for part in self.parts
            if part.same and part.offset >= 0 and part.offset + part.size <= len(held)
        )

    @cached_property
    def told(self) -> Mapping[str, Part]:
        """The parts that tell something by name: all but constants, length and check."""
        roles = ("address", "id", "code", "other")
        return {part.name: part for part in self.parts if part.role in roles}

    def values(self, frame: bytes) -> dict[str, int]:
        """The value in a whole frame of each part that tells something."""
        return {name: part.read(frame) for name, part in self.told.items()}

    def size(self, held: bytes, data: DataSpec | None, asked: Values | None = None) -> int | None:
        """How many bytes the frame has that begins so, with data laid out as `data`.

        None if that is not known yet, -1 if this can be no frame.
        """
        if not self.begins(held):
            return -1
        if len(held) < self.head:
            return None
        announced = self.value("length", held)
        if announced is not None:
            return self.head + announced + self.tail if 0 <= announced <= _MOST_DATA else -1
        if not self.has_data or data is None:
            return self.head + self.tail
        count = data.measure(held[self.head :], asked)
        if count is None or count <= _MOST_DATA:
            return None if count is None else self.head + count + self.tail
        return -1

    def build(self, values: Mapping[str, int], data: bytes, covered: bytes = b"") -> bytes:
        """The frame of these parts and data, with its length and its check.

        A part that is not given is 0; `covered` is what the request's check covers. Raises
        OverflowError for a value that does not fit.
        """
        size = self.head + len(data) + self.tail
        frame = bytearray(size)
        frame[self.head : self.head + len(data)] = data
        for part in self.parts:
            if part.role == "check":
                continue
            at = part.offset if part.offset >= 0 else size + part.offset
            given = {"length": len(data), "constant": part.low}.get(part.role)
            if given is None:
                given = values.get(part.name, 0)
            before = bytes(frame[at : at + part.size])
            frame[at : at + part.size] = part.constant or self._written(part, given, before)
        if self.check:
            at = size + self.check.part.offset
            right = self.check.right(bytes(frame), covered)
            frame[at : at + len(right)] = right
        return bytes(frame)

    @staticmethod
    def _written(part: Part, value: int, before: bytes) -> bytes:
        """The bytes of a part; in a byte of bits the other bits stay as they are."""
        value += part.also
        if not part.width:
            return part.number.build(value)
        if not 0 <= value < 1 << part.width:
            raise OverflowError(f"{part.name} is {value}, it has {part.width} bits")
        return part.number.build(part.number.parse(before) | value << part.shift)


def read_layout(what: str, declared: Construct, asked: tuple[str, ...] = ()) -> tuple[Layout, Any]:
    """Read a declared frame into a layout, with the declaration of its data (None without one).

    `what` is FRAME, REPLY or ERROR, `asked` are the covered parts of the request. Raises
    WrongValue.
    """
    body = unwrapped(declared)
    if isinstance(body, Answers):
        body = Struct("code" / body)
    if not isinstance(body, Struct):
        raise WrongValue(f"{what} is a {type(body).__name__}, it must be a Struct of parts")
    reader = _Reader(what, asked)
    reader.struct(body)
    return reader.layout(), reader.data


class _Reader:
    def __init__(self, what: str, asked: tuple[str, ...]) -> None:
        self._what = what
        self._asked = asked
        self._names = {"_"}  # of all that was read so far; `_` goes out of a Struct
        self._front: list[Part] = []
        self._behind: list[Part] = []  # offsets from the first byte behind the data
        self._at = 0
        self._spans: dict[str, tuple[bool, int, bool, int]] = {}  # covered: begin, end as places
        self._check: tuple[Part, Checksum] | None = None
        self.data: Any = None

    @property
    def _parts(self) -> list[Part]:
        return self._front if self.data is None else self._behind

    def struct(self, declared: Struct) -> None:
        """Read the parts of a Struct one after the other."""
        for member in declared.subcons:
            self._member(member)
        if len(self._front) + len(self._behind) > _MOST_PARTS:
            raise WrongValue(f"{self._what} has more than {_MOST_PARTS} parts")

    def _member(self, member: Construct) -> None:
        body, name = unwrapped(member), member.name or ""
        self._names.add(name)
        require_text(f"the prose of a part of {self._what}", prose_of(member))
        if isinstance(body, RawCopy):
            self._covered(name, body)
        elif isinstance(body, Const):
            self._add(member, "constant", _size_of(body, self._what), constant=body.build(None))
        elif isinstance(body, Checksum):
            self._checksum(member, body)
        elif _is_bits(body):
            self._bits(body)
        elif isinstance(body, Struct):
            self.struct(body)
        elif name == "data" or isinstance(body, Data | Switch | FixedSized):
            self._place_of_data(body)
        else:
            self._number(member, body)

    def _covered(self, name: str, body: RawCopy) -> None:
        require_word(f"the name of the covered part of {self._what}", name)
        inner = unwrapped(body.subcon)
        if not isinstance(inner, Struct):
            raise WrongValue(f"{self._what}.{name} must be written RawCopy(Struct(...))")
        begin = self.data is not None, self._at
        self.struct(inner)
        self._spans[name] = (*begin, self.data is not None, self._at)

    def _place_of_data(self, body: Construct) -> None:
        if self.data is not None:
            raise WrongValue(f"{self._what} has two places for data")
        inner = body
        if isinstance(body, FixedSized):
            self._require_path("FixedSized", body.length, "length")
            inner = unwrapped(body.subcon)
        elif isinstance(body, Switch) and any(
            part.role == "length" and not part.width for part in self._front
        ):
            raise WrongValue(
                f"the data of {self._what} must be written FixedSized(this.length, ...), since "
                f"{self._what} has a length"
            )
        if isinstance(inner, Switch) and any(part.role == "id" for part in self._front):
            self._require_path("Switch", inner.keyfunc, "id")
        self.data, self._at, self._head = body, 0, self._at

    def _require_path(self, word: str, expression: Any, name: str) -> None:
        """Raise WrongValue unless an expression is the path to the part of that name."""
        names = path_of(expression)
        if names[-1:] != (name,) or not self._names.issuperset(names):
            told = f"this.{'.'.join(names)}" if names else "..."
            raise WrongValue(
                f"{self._what} has {word}({told}, ...), allowed is the path to its part {name}: "
                f"{word}(this.{name}, ...)"
            )

    def _number(
        self, member: Construct, body: Construct, bits: Mapping[str, Any] | None = None
    ) -> None:
        """Read a part that is a number; `bits` is where it is in a byte of bits."""
        name = f"{self._what}.{member.name}"
        if member.name is None:
            raise WrongValue(f'a part of {self._what} has no name; write it "name" / type')
        require_word(f"the name of a part of {self._what}", member.name)
        place = bits or {"number": number_of(_type_of(body), name)}
        most = (1 << bits["width"]) - 1 if bits else place["number"].high
        role: Role = _ROLES.get(member.name, "other")
        more: dict[str, Any] = {}
        if isinstance(body, Address):
            ends = (body.high, body.broadcast or 0)
            _require_room(name, "addresses", ends, most)
            role = "address"
            more = {"low": body.low, "high": body.high, "broadcast": body.broadcast}
        elif isinstance(body, Length):
            role, more = "length", {"also": body.also}
        elif isinstance(body, Same):
            role, more = _ROLES.get(body.part, "other"), {"same": body.part, "plus": body.plus}
        elif isinstance(body, Answers):
            _require_room(name, "codes", body.answers, most)
            role = "code"
        else:
            more = {"high": most}
        self._add(member, role, **place, **more)

    def _bits(self, body: Construct) -> None:
        """Read a byte (or some) of bits: whole parts of it with their widths."""
        members = unwrapped(body.subcon).subcons
        for part in members:
            bits = _type_of(part)
            name = f"{self._what}.{part.name}"
            if type(bits) is not BitsInteger or bits.signed or bits.swapped:
                raise WrongValue(f"{name} must be written BitsInteger(width)")
            self._names.add(part.name or "")
            require_text(f"the prose of {name}", prose_of(part))
            require_whole(f"the width of {name}", bits.length, 1, 64)
        above = sum(_type_of(part).length for part in members)
        if above % 8 or not above:
            raise WrongValue(
                f"the bits of {self._what} are {above} together; they must fill whole bytes"
            )
        number = Number(above // 8, "big", signed=False)
        for part in members:
            width = _type_of(part).length
            above -= width
            place = {"number": number, "width": width, "shift": above, "moves": above == 0}
            inner = unwrapped(part)
            if isinstance(inner, Const):
                self._add(part, "constant", low=inner.value, **place)
            else:
                self._number(part, inner, place)

    def _checksum(self, member: Construct, body: Checksum) -> None:
        name = f"{self._what}.{member.name}"
        if self._check:
            raise WrongValue(f"{self._what} has two checks")
        if not isinstance(body.hashfunc, CheckFunction):
            raise WrongValue(
                f"{name} must be a Sum, a Fletcher, a Xor or a Crc of bilprov.spec.fields"
            )
        number = number_of(unwrapped(body.checksumfield), name)
        function, largest = body.hashfunc, (1 << body.hashfunc.bits) - 1
        if number.high < largest:
            raise WrongValue(
                f"{name} is a {type(function).__name__} of up to {largest} in a type of up to "
                f"{number.high}; give it a wider type or a narrower check"
            )
        self._check = self._add(member, "check", number), body

    def _add(
        self, member: Construct, role: Role, number: Number, *, moves: bool = True, **more: Any
    ) -> Part:
        part = Part(member.name or "", prose_of(member), role, self._at, number, **more)
        if role in ("id", "length", "address", "code") and any(
            one.role == role for one in (*self._front, *self._behind)
        ):
            raise WrongValue(f"{self._what} has two parts for the {role}")
        if self.data is not None and role in ("id", "length"):
            raise WrongValue(f"the {role} of {self._what} is behind the data; it must be before")
        self._parts.append(part)
        if moves:
            self._at += number.size
        return part

    def layout(self) -> Layout:
        """The layout of what was read."""
        has_data = self.data is not None
        head, tail = (self._head, self._at) if has_data else (self._at, 0)
        behind = [replace(part, offset=part.offset - tail) for part in self._behind]
        check = self._read_check(head, tail) if self._check else None
        front = [check.part if check and part.role == "check" else part for part in self._front]
        counted = [self._covered_name(self._check[1])[0]] if self._check else self._spans
        return Layout((*front, *behind), head, tail, check, has_data, tuple(counted))

    def _read_check(self, head: int, tail: int) -> Check:
        assert self._check is not None
        part, declared = self._check
        has_data = self.data is not None
        offset = part.offset - (tail if has_data else head)
        name, asked = self._covered_name(declared)
        after_begin, begin, after_end, end = self._spans[name]
        if after_begin or offset >= 0 or (has_data and not after_end):
            raise WrongValue(
                f"the check of {self._what} must stand behind the data, and cover them and what is "
                "before them"
            )
        last = (tail if has_data else head) - end
        return Check(replace(part, offset=offset), declared.hashfunc, begin, last, asked)

    def _covered_name(self, declared: Checksum) -> tuple[str, bool]:
        """Which covered part a check counts, and whether the request's stands before it."""
        for name in self._spans:
            context = Container({name: Container(data=_HERE)})
            covered = Container(data=_ASKED)
            context["_params"] = Container(asked=Container(dict.fromkeys(self._asked, covered)))
            try:
                found = declared.bytesfunc(context)
            except Exception:
                continue
            if found in (_HERE, _ASKED + _HERE):
                return name, found != _HERE
        besides = f", or asked.{self._asked[0]}.data + this.covered.data," if self._asked else ""
        raise WrongValue(
            f"the check of {self._what} must cover one part: write this.covered.data{besides} "
            'behind "covered" / RawCopy(Struct(...))'
        )


def _type_of(declared: Construct) -> Construct:
    """The number within what a part is declared as."""
    body = unwrapped(declared)
    marks = Address | Answers | Const | Length | Same
    return _type_of(body.subcon) if isinstance(body, marks) else body


def _require_room(name: str, what: str, values: Iterable[int], most: int) -> None:
    """Raise WrongValue for a value that does not fit into the type of a part."""
    if max(values, default=0) > most:
        raise WrongValue(f"{name} has {what} up to {max(values)} in a type of up to {most}")


def _is_bits(body: Construct) -> bool:
    return isinstance(getattr(body, "subcon", None), Struct) and type(body) is type(BitStruct())


def _size_of(body: Const, what: str) -> Number:
    raw = body.build(None)
    require_whole(f"the size of a constant of {what} in bytes", len(raw), 1, 64)
    return Number(len(raw), "big", signed=False)
