"""What the columns of requests and of answers have in common: parts, data and checks of frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from bilprov.spec.checks import CheckFunction, Crc, Fletcher, Sum, Xor
from bilprov.spec.data import DataSpec, FieldSpec, Number, context_of
from bilprov.spec.fields import Outcome
from bilprov.spec.layout import Layout, Part

Bytes: TypeAlias = NDArray[np.uint8]
Places: TypeAlias = NDArray[np.int64]
Mask: TypeAlias = NDArray[np.bool_]
Numbers: TypeAlias = Mapping[str, Places]
"""The numbers in some requests, by name."""

NO_NUMBERS: Numbers = {}

OUTCOMES = tuple(Outcome)
"""The outcomes in the order of the codes in a column of verdicts; 0 is a valid frame."""

VALID, BAD_DATA = OUTCOMES.index(Outcome.VALID), OUTCOMES.index(Outcome.BAD_DATA)
WIDEST = 7
"""Bytes of a field whose values, signed or not, all fit into 64 bits."""


class Requests(NamedTuple):
    """Whole frames in a buffer, one row each.

    `offset` is where a frame begins, `size` its bytes, `verdict` a place in `OUTCOMES`. `kind` is
    what the tables know it by: the place of its instruction in `Protocol.instructions`; of a frame
    with one header byte that byte times 256, plus the first byte of its data where that decides.
    """

    offset: Places
    size: Places
    kind: Places
    verdict: NDArray[Any]

    def rows(self, rows: slice | Mask | Places) -> Requests:
        """Some of the rows."""
        return Requests(*(column[rows] for column in self))

    def and_then(self, other: Requests) -> Requests:
        """These rows and those of `other`, of the same buffer."""
        columns: list[NDArray[Any]] = [
            np.concatenate(both) for both in zip(self, other, strict=True)
        ]
        return Requests(*columns)

    @property
    def end(self) -> Places:
        """Where each frame ends."""
        return self.offset + self.size


Rows = TypeVar("Rows")


class Cut(NamedTuple, Generic[Rows]):
    """The `whole` requests, or answers, of a buffer up to byte `end`.

    With `regular` what follows is the beginning of another one, or nothing, or an answer waits for
    its request; without it, it is a request that is not valid, an answer that is damaged or in the
    layout of errors, or neither.
    """

    whole: Rows
    end: int
    regular: bool


def leading(good: Mask) -> int:
    """How many are good before the first that is not."""
    return len(good) if good.all() else int(np.argmin(good))


def field_values(part: FieldSpec, data: NDArray[np.uint8], at: NDArray[np.int64]) -> NDArray[Any]:
    """The value of a field in each of the data that begin `at` some places and carry it."""
    at = at + part.offset
    if part.number and part.size <= WIDEST:
        return number_values(part.number, data, at)
    raw = data.take(at[:, None] + np.arange(part.size)).view(f"V{part.size}").ravel()
    distinct, place = np.unique(raw, return_inverse=True)
    values = [part.parse(one.tobytes()) for one in distinct]
    return np.take(np.array(values) if values else np.zeros(0, np.int64), place)


def number_values(
    number: Number, data: NDArray[np.uint8], at: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The numbers whose first bytes are at these places of `data`; of at most WIDEST bytes.

    Those that reach beyond the data are wrong.
    """
    if number.size == 1:
        return _byte_values(number).take(data.take(at, mode="clip"))
    places = range(number.size) if number.order == "big" else reversed(range(number.size))
    value = np.zeros(len(at), np.int64)
    for place in places:
        value <<= 8
        value |= data.take(at + place, mode="clip")
    if number.signed:
        half = np.int64(1 << 8 * number.size - 1)
        value = (value ^ half) - half
    return value


@lru_cache(maxsize=256)
def _byte_values(number: Number) -> NDArray[np.int64]:
    return np.array([number.parse(bytes([byte])) for byte in range(256)], np.int64)


def require_narrow(layout: Layout) -> None:
    """Raise OverflowError for a layout with a part that does not fit into 64 bits."""
    for part in layout.parts:
        if part.role != "constant" and part.size > WIDEST:
            raise OverflowError(f"{part.name} does not fit into 64 bits")


def part_values(part: Part, data: Bytes, start: Places, end: Places) -> Places:
    """The value of a part in each of the frames from start to end; see `Part.read`."""
    value = number_values(part.number, data, (start if part.offset >= 0 else end) + part.offset)
    if part.width:
        value = value >> part.shift & (1 << part.width) - 1
    return value - part.also if part.also else value


def constants_hold(layout: Layout, data: Bytes, start: Places, end: Places) -> Mask:
    """Which of the frames have the right constants."""
    found = np.ones(len(start), np.bool_)
    for offset, mask, value in layout.fixed:
        found &= data.take((start if offset >= 0 else end) + offset, mode="clip") & mask == value
    return found


def checks_hold(
    layout: Layout, data: Bytes, start: Places, end: Places, before: Checking | None = None
) -> Mask:
    """Which of the frames have the right check; `before` has counted what stands before them."""
    check = layout.check
    if check is None:
        return np.ones(len(start), np.bool_)
    checking = before or Checking(check.function, len(start))
    checking.take(data, start + check.first, end - check.last)
    right: Mask = part_values(check.part, data, start, end) == checking.values
    return right


class Sizes:
    """The sizes of frames by their kind, each laid out in its own way; that of kind -1 is 0."""

    def __init__(self, ways: Sequence[tuple[Layout, DataSpec]]) -> None:
        self.ways = ways
        # Of the kinds whose frames all have the same size; 0 of those that are `varied`.
        self.fixed = np.array([*(_fixed_size(*way) for way in ways), 0], np.int64)
        self.varied = [kind for kind, size in enumerate(self.fixed[:-1]) if not size]

    def at(self, kinds: Places, data: Bytes, start: Places) -> Places:
        """The sizes of frames of these kinds that begin at these places; see `frame_sizes`."""
        found = self.fixed.take(kinds)
        for kind in self.varied:
            rows = np.flatnonzero(kinds == kind)
            if len(rows):
                found[rows] = frame_sizes(*self.ways[kind], data, start[rows])
        return found


def _fixed_size(layout: Layout, spec: DataSpec) -> int:
    """The size of all frames with data laid out as `spec`; 0 where it differs."""
    counted = layout.has_data and spec.counted is not None and not spec.takes_rest
    if layout.part("length") is not None or counted:
        return 0
    return layout.head + layout.tail + (spec.length if layout.has_data else 0)


def frame_sizes(layout: Layout, spec: DataSpec, data: Bytes, start: Places) -> Places:
    """The sizes of the frames that begin at these places, with data laid out as `spec`.

    A size is 0 where there is no such frame; one that reaches beyond the data may be wrong.
    """
    around, length = layout.head + layout.tail, layout.part("length")
    if length is not None:
        announced = part_values(length, data, start, start)
        return np.where(announced < 0, 0, around + announced)
    if not layout.has_data:
        return np.full(len(start), around)
    return around + data_sizes(spec, data, start + layout.head)


def field_numbers(spec: DataSpec, data: Bytes, at: Places) -> dict[str, Places]:
    """The fields that are one number each, by name, of the data that begin at these places."""
    return {
        part.name: number_values(part.number, data, at + part.offset)
        for part in spec.fields
        if part.number and part.size <= WIDEST
    }


def data_sizes(spec: DataSpec, data: Bytes, at: Places, asked: Numbers = NO_NUMBERS) -> Places:
    """How many bytes the data have that begin at each place; see `DataSpec.measure`.

    `asked` has the numbers of the requests that they answer. Raises OverflowError for a count that
    cannot be worked out for arrays.
    """
    many = spec.counted
    if many is None or many.how == "rest":
        return np.full(len(at), spec.length)
    if many.prefix:
        width = 1 if many.how == "bytes in front" else many.width
        count = number_values(many.prefix, data, at + spec.fields[-1].offset)
        return spec.length + width * count
    assert many.expression is not None
    context = context_of(field_numbers(spec, data, at), asked)
    try:
        with np.errstate(divide="ignore"):
            count = np.broadcast_to(np.asarray(many.expression(context)), len(at))
    except Exception as error:  # an expression may hold anything, also what takes no arrays
        raise OverflowError("a count takes no arrays") from error
    if count.dtype.kind not in "iu":
        raise OverflowError("a count is not a whole number")
    return spec.length + np.maximum(count.astype(np.int64), 0) * many.width


def sized(
    layout: Layout,
    spec: DataSpec,
    data: Bytes,
    start: Places,
    end: Places,
    asked: Numbers = NO_NUMBERS,
) -> Mask:
    """Which frames from start to end have as many bytes of data as are needed."""
    at = start + layout.head
    size = end - layout.tail - at
    good: Mask = size >= spec.length
    if layout.part("length") is not None and not spec.takes_rest:
        good &= size == data_sizes(spec, data, at, asked)
    return good


def require_arrays(spec: DataSpec, asked: Numbers = NO_NUMBERS) -> None:
    """Raise OverflowError for data whose sizes cannot be worked out for arrays.

    `asked` has the numbers of two requests that they answer.
    """
    data_sizes(spec, np.zeros(1, np.uint8), np.zeros(2, np.int64), asked)


def in_range(part: FieldSpec, data: Bytes, at: Places, size: Places) -> Mask:
    """Which of the fields at these places, the last one of `size` bytes, are in their range."""
    good, many = np.ones(len(at), np.bool_), part.many
    if part.constant is not None:
        for place, byte in enumerate(part.constant):
            good &= data.take(at + place, mode="clip") == byte
    elif many is None and not part.unlimited:
        good = _numbers_in_range(part, data, at)
    if many is None:
        return good
    before, count = many.prefix.size if many.prefix else 0, np.full(len(at), many.fixed)
    if many.how != "fixed":
        count, over = np.divmod(size - before, many.width)
        good = over == 0
    for place in range(0 if part.unlimited else int(count.max(initial=0))):
        rows = np.flatnonzero(good & (count > place))
        good[rows] = _numbers_in_range(part, data, at[rows] + before + place * many.width)
    return good


def _numbers_in_range(part: FieldSpec, data: Bytes, at: Places) -> Mask:
    assert part.element
    value = number_values(part.element, data, at)
    good = (value >= part.low) & (value <= part.high)
    if part.names:
        good &= np.isin(value, [known for _, known in part.names])
    if part.flags:
        good &= value & ~np.int64(part.mask) == 0
    return good


class Checking:
    """A check of stretches of bytes, each in one or more pieces.

    `count` is the number of stretches. `take` counts a piece of each, `values` are the checks.
    """

    def __init__(self, function: CheckFunction, count: int) -> None:
        self._function = function
        first = getattr(function, "first", 0)
        self._register = np.full(count, first, np.int64)
        self._second = np.zeros(count, np.int64)  # of a Fletcher the sum of its sums

    def take(self, data: Bytes, start: Places, end: Places) -> None:
        """Count the bytes of `data` from each start to its end."""
        if isinstance(self._function, Crc):
            self._register = _folded(self._function, self._register, data, start, end)
        elif isinstance(self._function, Sum | Fletcher):
            sums = np.cumsum(data, dtype=np.int64)
            if isinstance(self._function, Fletcher):
                before = np.append(np.int64(0), sums).take(start)  # what the sums have too much
                self._second += (end - start) * (self._register - before)
                self._second += _between(np.cumsum(sums), np.subtract, start, end)
            self._register += _between(sums, np.subtract, start, end)
        else:
            upto = np.bitwise_xor.accumulate(data.astype(np.int64))
            self._register ^= _between(upto, np.bitwise_xor, start, end)

    @property
    def values(self) -> Any:
        """The checks of what was counted."""
        if isinstance(self._function, Fletcher):
            return self._function.of(self._register, self._second)
        if isinstance(self._function, Xor):
            return self._register
        return self._function.of(self._register)


def _between(upto: Places, difference: Callable[..., Any], start: Places, end: Places) -> Any:
    """The sums from each start to its end, of the sums up to and with each byte."""
    upto = np.append(np.int64(0), upto)
    return difference(upto.take(end), upto.take(start))


def _folded(crc: Crc, register: Places, data: Bytes, start: Places, end: Places) -> Places:
    """The registers after the bytes from each start to its end.

    All stretches take their first byte together, then their second one, and so on; the longest
    stand in front, so that those which still have a byte are the first ones. A register of 16 bits
    takes two bytes at once, the first byte of an odd number before.
    """
    size = end - start
    most = int(size.max(initial=0))
    # Numbers of 16 bits are sorted several times as fast.
    shorter = (most - size).astype(np.uint16 if most < 1 << 16 else np.int64)
    order = np.argsort(shorter, kind="stable")
    at, value, size = start[order], register[order], size[order]
    if crc.width == 16:
        odd = np.flatnonzero(size & 1)
        value[odd] = _stepped(crc, value[odd], data.take(at[odd]))
        at[odd] += 1
        pairs, table, held = _pairs(crc, data), _table_of_pairs(crc), value.astype(np.uint16)
        for place, count in enumerate(_still(size // 2)):
            met = held[:count] ^ pairs.take(at[:count] + 2 * place)
            np.take(table, met, out=held[:count], mode="clip")
        value = held.astype(np.int64)
    else:
        for place, count in enumerate(_still(size)):
            value[:count] = _stepped(crc, value[:count], data.take(at[:count] + place))
    found = np.empty_like(value)
    found[order] = value
    return found


def _still(size: NDArray[np.int64]) -> list[int]:
    """How many of these sizes, which fall, are larger than 0, 1, 2 ..."""
    counts = np.bincount(size)
    found: list[int] = (len(size) - np.cumsum(counts))[:-1].tolist()
    return found


def _stepped(crc: Crc, register: NDArray[np.int64], byte: NDArray[np.integer]) -> NDArray[np.int64]:
    """The registers after one more byte each."""
    table = _table(crc)
    if crc.reflected:
        return register >> 8 ^ table.take((register ^ byte) & 0xFF)
    bits = crc.width + crc.spare
    kept = register << 8 & (1 << bits) - 1
    return kept ^ table.take(register >> bits - 8 ^ byte)


def _pairs(crc: Crc, data: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Each byte with the next one, as the two meet a register of 16 bits."""
    first, second = (0, 8) if crc.reflected else (8, 0)
    wide = data.astype(np.uint16)
    pairs: NDArray[np.uint16] = wide[:-1] << np.uint16(first) | wide[1:] << np.uint16(second)
    return pairs


@lru_cache(maxsize=16)
def _table(crc: Crc) -> NDArray[np.int64]:
    return np.array(crc.table, np.int64)


@lru_cache(maxsize=4)
def _table_of_pairs(crc: Crc) -> NDArray[np.uint16]:
    """The register of 16 bits after two bytes, by what it and the bytes are together."""
    both, none = np.arange(1 << 16), np.zeros(1 << 16, np.int64)
    return _stepped(crc, _stepped(crc, both, none), none).astype(np.uint16)
