"""What the columns of requests and of answers have in common: parts, data and checks of frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from construct import Container
from numpy.typing import NDArray

from bilprov.spec.arrays.checks import Checking
from bilprov.spec.data import DataSpec, FieldSpec
from bilprov.spec.fields import Outcome
from bilprov.spec.layout import Layout, Part
from bilprov.spec.numbers import Number

Bytes: TypeAlias = NDArray[np.uint8]
Places: TypeAlias = NDArray[np.int64]
Mask: TypeAlias = NDArray[np.bool_]

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


class Told(NamedTuple):
    """The sizes of frames that one byte of a frame tells: that byte's place and the size by it.

    The size is 0 where there is no such frame.
    """

    place: int
    sizes: tuple[int, ...]

    def at(self, data: Bytes, offset: Places) -> Places:
        """The sizes of the frames at these places."""
        return np.array(self.sizes, np.int64).take(data.take(offset + self.place, mode="clip"))


def size_by_byte(layout: Layout, data: DataSpec | None) -> int | Told | None:
    """The size that all frames with such data have, or the byte that tells it; None otherwise."""
    around = layout.head + layout.tail
    length = layout.part("length")
    if length is not None:
        if length.size > 1:
            return None
        announced = [length.read(_alone(length, byte)) for byte in range(256)]
        return Told(length.offset, tuple(around + n if n >= 0 else 0 for n in announced))
    if not layout.has_data or data is None:
        return around
    many = data.counted
    if many is None or many.how == "rest":
        return around + data.length
    if many.prefix is None or many.prefix.size > 1:
        return None
    width = 1 if many.how == "bytes in front" else many.width
    least = around + data.length
    place = layout.head + data.fields[-1].offset
    return Told(place, tuple(least + width * count for count in range(256)))


def _alone(part: Part, byte: int) -> bytes:
    """A frame in which a part of one byte in front has this byte."""
    return bytes(part.offset) + bytes([byte])


def field_values(part: FieldSpec, data: NDArray[np.uint8], at: NDArray[np.int64]) -> NDArray[Any]:
    """The value of a field in each of the data that begin `at` some places and carry it."""
    at = at + part.offset
    if part.number and part.size == 1:
        return np.take(_byte_values(part.number), data.take(at))
    if part.number and part.size <= WIDEST:
        return number_values(part.number, data, at)
    raw = data.take(at[:, None] + np.arange(part.size)).view(f"V{part.size}").ravel()
    distinct, place = np.unique(raw, return_inverse=True)
    values = [part.parse(one.tobytes()) for one in distinct]
    return np.take(np.array(values) if values else np.zeros(0, np.int64), place)


def number_values(
    number: Number, data: NDArray[np.uint8], at: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The numbers whose first bytes are at these places of `data`; of at most WIDEST bytes."""
    places = range(number.size) if number.order == "big" else reversed(range(number.size))
    value = np.zeros(len(at), np.int64)
    for place in places:
        value <<= 8
        value |= data.take(at + place)
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
    return value - part.also


def same_bytes(raw: bytes, data: Bytes, at: Places) -> Mask:
    """Whether these bytes stand at each place."""
    found = np.ones(len(at), np.bool_)
    for place, byte in enumerate(raw):
        found &= data.take(at + place, mode="clip") == byte
    return found


def constants_hold(layout: Layout, data: Bytes, start: Places, end: Places) -> Mask:
    """Which of the frames have the right constants."""
    found = np.ones(len(start), np.bool_)
    for offset, raw in layout.constants:
        found &= same_bytes(raw, data, (start if offset >= 0 else end) + offset)
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


def data_sizes(spec: DataSpec, data: Bytes, at: Places, one_by_one: Callable[[int], int]) -> Places:
    """How many bytes the data have that begin at each place, with at least `spec.length` bytes.

    `one_by_one` measures those of one row, where only the fields together tell.
    """
    many = spec.counted
    if many is None or many.how == "rest":
        return np.full(len(at), spec.length)
    if many.prefix:
        width = 1 if many.how == "bytes in front" else many.width
        count = number_values(many.prefix, data, at + spec.fields[-1].offset)
        return spec.length + width * count
    return np.array([one_by_one(row) for row in range(len(at))], np.int64)


def sizes_by_request(spec: DataSpec, asked: Mapping[str, Places], count: int) -> Places | None:
    """How many bytes the data of answers have, if the request alone tells it; None otherwise.

    `asked` are the numbers in each of `count` requests by name.
    """
    many = spec.counted
    if many is None or many.expression is None:
        return None
    context = Container({"_params": Container(asked=Container(asked))})
    try:
        found = np.asarray(many.expression(context))
    except Exception:  # an expression may hold anything, also what takes no arrays
        return None
    if found.dtype.kind not in "iu" or found.shape not in ((), (count,)):
        return None
    sizes = spec.length + np.maximum(found.astype(np.int64), 0) * many.width
    return np.broadcast_to(sizes, count)


def in_range(part: FieldSpec, data: Bytes, at: Places, size: Places) -> Mask:
    """Which of the fields at these places, the last one of `size` bytes, are in their range."""
    if part.constant is not None:
        return same_bytes(part.constant, data, at)
    if part.many and part.many.how != "fixed":
        before = part.many.prefix.size if part.many.prefix else 0
        whole: Mask = (size - before) % part.many.width == 0
        return whole
    if part.number is None or part.unlimited:
        return np.ones(len(at), np.bool_)
    value = number_values(part.number, data, at)
    good = (value >= part.low) & (value <= part.high)
    if part.names:
        good &= np.isin(value, [known for _, known in part.names])
    if part.flags:
        good &= value & ~np.int64(part.mask) == 0
    return good
