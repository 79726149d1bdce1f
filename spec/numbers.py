"""Whole numbers of construct, read into a byte order and a sign, so that they are read fast."""

from __future__ import annotations

from typing import Any, Literal

import msgspec
from construct import BytesInteger, Construct, FormatField

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
    """
    if isinstance(declared, BytesInteger):
        size, signed, little = declared.length, declared.signed, declared.swapped
        if isinstance(size, int) and 0 < size < 256 and isinstance(little, bool):
            return Number(size, _ORDERS[little], bool(signed))
    if isinstance(declared, FormatField):
        order, kind = declared.fmtstr
        native = order == "=" and declared.parse(b"\1".ljust(declared.length, b"\0")) == 1
        little = order == "<" or native
        if kind in "BHLQbhlq":
            return Number(declared.length, _ORDERS[little], kind.islower())
        if kind in "efd":
            bits = 8 * declared.length
            raise WrongValue(
                f"{what} is a floating-point number; declare its bits, Int{bits}ub or Int{bits}ul"
            )
    raise WrongValue(f"the type of {what} must be a whole number, such as Byte{others}")
