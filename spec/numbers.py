"""Whole numbers of construct, read into a byte order and a sign, so that they are read fast."""

from __future__ import annotations

from typing import Any, Literal

import msgspec
from construct import Construct

from bilprov.spec.errors import WrongValue

Order = Literal["big", "little"]


_ORDERS: tuple[Order, ...] = ("big", "little")


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


class _Path:
    """Stands for what was parsed before, and remembers the names by which it is looked into."""

    def __init__(self, *names: str) -> None:
        self.names = names

    def __getitem__(self, name: str) -> _Path:
        return _Path(*self.names, name)

    __getattr__ = __getitem__


def path_of(expression: Any) -> tuple[str, ...]:
    """The names in an expression like `this.header.id`; none for any other."""
    try:
        found = expression(_Path())
    except Exception:  # it computes, or is no expression
        return ()
    return found.names if isinstance(found, _Path) else ()


def number_of(declared: Construct, what: str, others: str = "") -> Number:
    """Read a whole number of construct. Raises WrongValue for anything else.

    `others` names what else is allowed there.

    What it is follows from how it reads and writes bytes in which every byte is another one.
    """
    refused = f"the type of {what} must be a whole number, such as Byte{others}"
    try:
        size = declared.sizeof()
        patterns = _patterns(size) if 0 < size < 256 else []
        values = [declared.parse(raw) for raw in patterns]
        if float in map(type, values):
            bits = f"Int{8 * size}ub or Int{8 * size}ul"
            refused = f"{what} is a floating-point number; declare its bits, {bits}"
        for order in _ORDERS:
            for signed in (False, True):
                number = Number(size, order, signed)
                read = [number.parse(raw) for raw in patterns]
                same = (
                    bool(values) and values == read and all(type(value) is int for value in values)
                )
                if same and [declared.build(value) for value in read] == patterns:
                    return number
    except Exception as error:  # construct raises many kinds for what is no number
        raise WrongValue(refused) from error
    raise WrongValue(refused)


def _patterns(size: int) -> list[bytes]:
    """Bytes from which the order and the sign of a number of that size follow."""
    rising = [bytes((start + 37 * place) % 256 for place in range(size)) for start in (1, 200)]
    low = bytes(size - 1)
    return [*rising, bytes(size), b"\xff" * size, b"\x80" + low, low + b"\x80"]
