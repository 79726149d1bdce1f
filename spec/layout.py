"""Reads FRAME, REPLY and ERROR into layouts: where each part of a frame is, and where it ends.

A layout is a plain value; no module but this one and `data` meets a construct of a frame. What
cannot be read into a layout raises WrongValue.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import accumulate
from typing import Annotated, Any, Literal

import construct
import msgspec
from construct import Construct
from msgspec.structs import replace

from bilprov.spec.checks import CheckFunction
from bilprov.spec.data import DataSpec, Number, Values, context_of, number_of, prose_of, unwrapped
from bilprov.spec.errors import WrongValue, require, require_word
from bilprov.spec.fields import Address, Answers, Data, Length, Same

Role = Literal["constant", "address", "id", "length", "code", "other", "check"]

Width = Annotated[int, msgspec.Meta(ge=1, le=64)]
_ROLES: dict[str, Role] = {"id": "id", "length": "length", "address": "address"}
_BITS = type(construct.BitStruct())
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

    @property
    def fixed(self) -> tuple[bytes, bytes]:
        """Of a constant a mask of its bits in its bytes, and their value."""
        if self.constant:
            return b"\xff" * self.size, self.constant
        mask = (1 << self.width) - 1
        return self.number.build(mask << self.shift), self.number.build(self.low << self.shift)

    def raw(self, frame: bytes) -> bytes:
        """Its bytes in a frame."""
        return frame[self.offset : self.offset + self.size or None]

    def read(self, frame: bytes) -> int:
        """Its value in a frame; a length is the number of data bytes."""
        value = self.number.parse(self.raw(frame))
        if self.width:
            value = value >> self.shift & (1 << self.width) - 1
        return value - self.also

    def written(self, value: int, before: bytes) -> bytes:
        """Its bytes with a value; in a byte of bits the others are as `before`."""
        value += self.also
        if not self.width:
            return self.number.build(value)
        if not 0 <= value < 1 << self.width:
            raise OverflowError(f"{self.name} is {value}, it has {self.width} bits")
        return self.number.build(self.number.parse(before) | value << self.shift)

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
        return self.part.raw(frame) == self.right(frame, asked)

    def right(self, frame: bytes, asked: bytes = b"") -> bytes:
        """The bytes that it must have in a frame; `asked` is what the request's check covers."""
        covered = self.covered(frame)
        return self.part.number.build(self.function(asked + covered if self.asked else covered))

    def wrong(self, frame: bytes, asked: bytes = b"") -> str:
        """What is wrong with it in a frame, in words; "" where it is right."""
        found, right = self.part.raw(frame), self.right(frame, asked)
        if found == right:
            return ""
        return f"{self.part.name} is {found.hex(' ')}, right is {right.hex(' ')}"


class Layout(msgspec.Struct, frozen=True, dict=True):
    """The parts of a frame in order: `head` bytes, the data, `tail` bytes.

    `has_data` is false for an answer without a place for data. `covered` names the parts that a
    check of the answer may count too: `asked.covered.data`. Frames with the IDs of `unchecked` have
    no check, which is all that stands behind the data of the others.
    """

    parts: tuple[Part, ...]
    head: int
    tail: int
    check: Check | None
    has_data: bool
    covered: tuple[str, ...] = ()
    unchecked: frozenset[int] = frozenset()

    def of(self, identity: int | None) -> Layout:
        """The layout of the frames with an ID."""
        return self._without_check if identity in self.unchecked else self

    def of_frame(self, begun: bytes) -> Layout:
        """The layout of the frame that begins so."""
        known = self.unchecked and len(begun) >= self.head
        return self.of(self.value("id", begun)) if known else self

    @cached_property
    def _without_check(self) -> Layout:
        parts = tuple(part for part in self.parts if part.role != "check")
        return replace(self, parts=parts, tail=0, check=None, unchecked=frozenset())

    def covered_in(self, frame: bytes) -> bytes:
        """What the check of a whole frame covers, or would; all of it where no frame has one."""
        if self.check is None:
            return frame
        checked = self.of_frame(frame).check
        return checked.covered(frame) if checked else frame[self.check.first :]

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
        for at, mask, value in self.fixed:
            if (at, mask) != (len(found), 0xFF):
                break
            found += bytes([value])
        return found

    @cached_property
    def constants(self) -> tuple[Part, ...]:
        """The constants, of whole bytes or of some bits."""
        return tuple(part for part in self.parts if part.role == "constant")

    @cached_property
    def fixed(self) -> tuple[tuple[int, int, int], ...]:
        """The offset of each byte that has constant bits, a mask of these, and their value."""
        return tuple(
            (part.offset + at, mask, value)
            for part in self.constants
            for at, (mask, value) in enumerate(zip(*part.fixed, strict=True))
            if mask
        )

    def value(self, role: Role, frame: bytes) -> int | None:
        """The value of the part of that role in a frame; None where it has no such part."""
        part = self._by_role.get(role)
        return part.read(frame) if part else None

    def data_of(self, frame: bytes) -> bytes:
        """The data in a whole frame."""
        return frame[self.head : len(frame) - self.tail]

    def begins(self, held: bytes) -> bool:
        """Whether bytes may begin a frame: the constants in front that are there are right."""
        size = len(held)
        return all(held[at] & mask == value for at, mask, value in self.fixed if 0 <= at < size)

    def wrong_constant(self, frame: bytes) -> str:
        """What is wrong with the first wrong constant in a whole frame; "" if all are right."""
        for part in self.constants:
            found = part.raw(frame)
            if part.width and part.read(frame) != part.low:
                return f"{part.name or 'a constant'} is {part.read(frame)}, right is {part.low}"
            if part.constant not in (b"", found):
                return f"{found.hex(' ')} stands where {part.constant.hex(' ')} must be"
        return ""

    def unrepeated(self, held: bytes, asked: Values | None) -> tuple[Part, int] | None:
        """The first part that does not repeat the request's, and its right value.

        Without a request, the first one that can repeat none. Only the parts count that are within
        the bytes; None if all of these do.
        """
        for part in self.parts:
            if part.same and 0 <= part.offset <= len(held) - part.size:
                found = part.read(held)
                if asked is None:
                    right = max(found, part.plus)
                else:
                    right = part.repeating(asked.get(part.same, -1))
                if found != right or (asked is not None and part.same not in asked):
                    return part, right
        return None

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
        around, announced = self.head + self.of_frame(held).tail, self.value("length", held)
        if announced is not None:
            return around + announced if 0 <= announced <= _MOST_DATA else -1
        if not self.has_data or data is None:
            return around
        count = data.measure(held[self.head :], asked)
        if count is None or count <= _MOST_DATA:
            return None if count is None else around + count
        return -1

    def build(self, values: Mapping[str, int], data: bytes, covered: bytes = b"") -> bytes:
        """The frame of these parts and data, with its length and its check.

        A part that is not given is 0; `covered` is what the request's check covers. Raises
        OverflowError for a value that does not fit.
        """
        layout = self.of(values.get("id"))
        size = self.head + len(data) + layout.tail
        frame = bytearray(size)
        frame[self.head : self.head + len(data)] = data
        for part in layout.parts:
            at = part.offset if part.offset >= 0 else size + part.offset
            value = {"length": len(data), "constant": part.low}.get(part.role)
            if value is None:
                value = values.get(part.name, 0)
            raw = part.constant or part.written(value, bytes(frame[at : at + part.size]))
            if part.role != "check":
                frame[at : at + part.size] = raw
        if check := layout.check:
            at = size + check.part.offset
            frame[at : at + check.part.size] = check.right(bytes(frame), covered)
        return bytes(frame)


def read_layout(what: str, declared: Construct, asked: tuple[str, ...] = ()) -> tuple[Layout, Any]:
    """Read a declared frame into a layout, with the declaration of its data (None without one).

    `what` is FRAME, REPLY or ERROR, `asked` are the covered parts of the request. Raises
    WrongValue.
    """
    body = unwrapped(declared)
    if isinstance(body, Answers):
        body = construct.Struct("code" / body)
    if not isinstance(body, construct.Struct):
        raise WrongValue(f"{what} is a {type(body).__name__}, it must be a Struct of parts")
    spans: dict[str, tuple[int, int]] = {}
    members = [*_members(what, body, spans, 0)]
    if len(members) > _MOST_PARTS:
        raise WrongValue(f"{what} has more than {_MOST_PARTS} parts")
    roles = [part.role if part else "data" for part, _ in members]
    for role in ("id", "length", "address", "code", "check", "data"):
        if roles.count(role) > 1:
            raise WrongValue(f"{what} has two parts for the {role}")
    place = roles.index("data") if "data" in roles else len(roles)
    for role in {"id", "length"} & {*roles[place:]}:
        raise WrongValue(f"the {role} of {what} is behind the data; it must be before")
    # The bytes before each member, and those of all; of a byte of bits the last part has the byte.
    before = [0, *accumulate(0 if one is None or one.shift else one.size for one, _ in members)]
    total, data = before[-1], None
    parts = tuple(
        replace(part, offset=before[at] - (total if at > place or part.role == "check" else 0))
        for at, (part, _) in enumerate(members)
        if part
    )
    if place < len(roles):
        data = members[place][1]
        _require_paths(what, data, [p for p in parts if p.offset >= 0])
    head = before[place]
    check, covered, unchecked = None, tuple(spans), frozenset[int]()
    if "check" in roles:
        at = roles.index("check")
        (part,) = (one for one in parts if one.role == "check")
        declared_check = members[at][1]
        if isinstance(declared_check, construct.Switch):
            if what != "FRAME" or part.size != total - head:
                raise WrongValue(
                    f"{what}.{part.name} is a Switch, allowed is one for the check of FRAME where "
                    "nothing else stands behind the data"
                )
            unchecked = _unchecked(what, declared_check)
            declared_check = unwrapped(declared_check.default)
        name, both = _covered_name(what, declared_check, spans, asked)
        first, last = spans[name]
        if at < last or (data is not None and not first <= place < last):
            raise WrongValue(
                f"the check of {what} must stand behind the data, and cover them and what is "
                "before them"
            )
        function, covered = declared_check.hashfunc, (name,)
        check = Check(part, function, before[first], total - before[last], both)
    found = Layout(parts, head, total - head, check, data is not None, covered, unchecked)
    return found, data


def _checksum(declared: Construct) -> Construct:
    """What a part is declared as; of a check that some frames lack, what the others have."""
    body = unwrapped(declared)
    if isinstance(body, construct.Switch):
        default = unwrapped(body.default)
        return default if isinstance(default, construct.Checksum) else body
    return body


def _unchecked(what: str, declared: construct.Switch) -> frozenset[int]:
    """The IDs of the frames without a check."""
    _require_path(what, "Switch", declared.keyfunc, "id", like="covered.value.id")
    for identity, case in declared.cases.items():
        require(f"an ID of {what} without a check", identity, int)
        if case is not construct.Pass:
            raise WrongValue(
                f"the check of {what} for ID {identity} is a {type(case).__name__}, allowed is "
                "Pass: no check"
            )
    return frozenset(declared.cases)


def _members(
    what: str, declared: construct.Struct, spans: dict[str, tuple[int, int]], at: int
) -> Iterator[tuple[Part | None, Construct]]:
    """Yield each part of a Struct with its declaration, and None with that of the data.

    `at` is the place of the first one; `spans` gets the places of what each RawCopy covers.
    """
    for member in declared.subcons:
        body, found = unwrapped(member), list[tuple[Part | None, Construct]]()
        inner = unwrapped(body.subcon) if isinstance(body, construct.RawCopy) else body
        is_check = isinstance(_checksum(inner), construct.Checksum)
        if isinstance(inner, construct.Struct):
            found += _members(what, inner, spans, at)
        elif type(inner) is _BITS:
            found += _bits(what, unwrapped(inner.subcon).subcons)
        elif member.name == "data" or (
            isinstance(inner, Data | construct.Switch | construct.FixedSized) and not is_check
        ):
            found.append((None, inner))
        else:
            found.append((_part(what, member), inner))
        yield from found
        if isinstance(body, construct.RawCopy):
            spans[member.name] = at, at + len(found)
        at += len(found)


def _require_paths(what: str, declared: Construct, before: Sequence[Part]) -> None:
    """Raise WrongValue unless data are as long as the part before tells, and those of its ID."""
    roles = [part.role for part in before if part.role != "length" or not part.width]
    paths = []
    if isinstance(declared, construct.FixedSized):
        paths.append(("FixedSized", declared.length, "length"))
        declared = unwrapped(declared.subcon)
    elif isinstance(declared, construct.Switch) and "length" in roles:
        raise WrongValue(
            f"the data of {what} must be written FixedSized(this.length, ...), since {what} has a "
            "length"
        )
    if isinstance(declared, construct.Switch) and "id" in roles:
        paths.append(("Switch", declared.keyfunc, "id"))
    for word, expression, name in paths:
        _require_path(what, word, expression, name)


def _require_path(what: str, word: str, expression: object, name: str, like: str = "") -> None:
    """Raise WrongValue unless an expression is a path to the part of that name."""
    path = re.sub(r"\['(\w+)'\]", r".\1", repr(expression))
    if not re.fullmatch(rf"this\.(\w+\.)*{name}", path):
        raise WrongValue(
            f"{what} has {word}({path}, ...), allowed is the path to its part {name}: "
            f"{word}(this.{like or name}, ...)"
        )


def _part(what: str, member: Construct, bits: Mapping[str, Any] | None = None) -> Part:
    """Read a part, its offset still 0; `bits` is where it is in a byte of bits."""
    body, name = _checksum(member), f"{what}.{member.name}"
    require(f"the prose of {name}", prose_of(member), str)
    if member.name is not None:
        require_word(f"the name of a part of {what}", member.name)
    elif not isinstance(body, construct.Const):
        raise WrongValue(f'a part of {what} has no name; write it "name" / type')
    role: Role = _ROLES.get(member.name, "other")
    if isinstance(body, construct.Const) and not bits:
        raw = body.build(None)
        require(f"the bytes of {name}", len(raw), Width)
        number = Number(len(raw), "big", signed=False)
        return Part(member.name or "", prose_of(member), "constant", 0, number, constant=raw)
    place = bits or {"number": number_of(_type_of(body), name)}
    most = (1 << bits["width"]) - 1 if bits else place["number"].high
    values: tuple[int, ...] = ()
    more: dict[str, Any] = {}
    if isinstance(body, construct.Const):
        role, values, more = "constant", (body.value,), {"low": body.value}
    elif isinstance(body, Address):
        role, values = "address", (body.high, body.broadcast or 0)
        more = {"low": body.low, "high": body.high, "broadcast": body.broadcast}
    elif isinstance(body, Length):
        role, more = "length", {"also": body.also}
    elif isinstance(body, Same):
        role, more = _ROLES.get(body.part, "other"), {"same": body.part, "plus": body.plus}
    elif isinstance(body, Answers):
        role, values = "code", tuple(body.answers)
    elif isinstance(body, construct.Checksum):
        if not isinstance(body.hashfunc, CheckFunction):
            raise WrongValue(
                f"{name} must be a Sum, a Fletcher, a Xor or a Crc of bilprov.spec.fields"
            )
        role, values = "check", ((1 << body.hashfunc.bits) - 1,)
    else:
        more = {"high": most}
    if not 0 <= max(values, default=0) <= most:
        raise WrongValue(
            f"{name} has values up to {max(values)} in a type of up to {most}; give it a wider type"
        )
    return Part(member.name or "", prose_of(member), role, 0, **place, **more)


def _bits(what: str, members: Sequence[Construct]) -> Iterator[tuple[Part, Construct]]:
    """Yield the parts of a byte (or some) of bits, each with its declaration."""
    types = [_type_of(member) for member in members]
    for member, bits in zip(members, types, strict=True):
        if type(bits) is not construct.BitsInteger or bits.signed or bits.swapped:
            raise WrongValue(f"{what}.{member.name} must be written BitsInteger(width)")
        require(f"the width of {what}.{member.name}", bits.length, Width)
    above = sum(bits.length for bits in types)
    if above % 8 or not above:
        raise WrongValue(f"the bits of {what} are {above} together; they must fill whole bytes")
    number = Number(above // 8, "big", signed=False)
    for member, bits in zip(members, types, strict=True):
        above -= bits.length
        place = {"number": number, "width": bits.length, "shift": above}
        yield _part(what, member, place), unwrapped(member)


def _covered_name(
    what: str, declared: construct.Checksum, spans: Iterable[str], asked: tuple[str, ...]
) -> tuple[str, bool]:
    """Which covered part a check counts, and whether the request's stands before it."""
    for name in spans:
        request = dict.fromkeys(asked, construct.Container(data=_ASKED))
        try:
            found = declared.bytesfunc(context_of({name: construct.Container(data=_HERE)}, request))
        except Exception:
            continue
        if found in (_HERE, _ASKED + _HERE):
            return name, found != _HERE
    besides = f", or asked.{asked[0]}.data + this.covered.data," if asked else ""
    raise WrongValue(
        f"the check of {what} must cover one part: write this.covered.data{besides} "
        'behind "covered" / RawCopy(Struct(...))'
    )


def _type_of(declared: Construct) -> Construct:
    """The number within what a part is declared as."""
    body = _checksum(declared)
    if isinstance(body, construct.Checksum):
        return unwrapped(body.checksumfield)
    marks = Address | Answers | construct.Const | Length | Same
    return _type_of(body.subcon) if isinstance(body, marks) else body
