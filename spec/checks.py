"""The checks that frames carry: sums, Fletcher's, exclusive ors and cyclic redundancy checks.

Each is a callable from the covered bytes to the value, as construct's `Checksum` takes one.
"""

from __future__ import annotations

import operator
from collections import deque
from collections.abc import Iterator
from functools import cached_property, reduce
from itertools import accumulate
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from msgspec import Meta
from msgspec.structs import force_setattr

from bilprov.spec.errors import Declared, WrongValue

Register = Annotated[int, Meta(ge=0, lt=1 << 32)]


class Sum(Declared, frozen=True):
    """The sum of the bytes, cut to `bits`.

    With `complement` 1 (or True) each bit of it is inverted, with 2 it is subtracted from zero:
    the ones' and the two's complement.
    """

    bits: Literal[8, 16, 24, 32] = 8
    complement: Annotated[int, Meta(ge=0, le=2)] | bool = 0

    def running(self, data: bytes) -> Iterator[int]:
        """The sum of the first 0, 1, 2, ... bytes, up to all."""
        return map(self.of, accumulate(data, initial=0))

    def __call__(self, data: bytes) -> int:
        """The sum of the bytes."""
        return int(self.of(sum(data)))

    def of(self, total: Any) -> Any:
        """The check of bytes with this total, a number or an array of numbers."""
        if self.complement:
            total = ~total + (self.complement == 2)
        return total & (1 << self.bits) - 1


class Fletcher(Declared, frozen=True):
    """The sum of the bytes, and above it the sum of that sum after each byte, both by `modulus`."""

    modulus: Literal[255, 256] = 256
    bits: ClassVar[int] = 16

    def running(self, data: bytes) -> Iterator[int]:
        """The check of the first 0, 1, 2, ... bytes, up to all."""
        sums = [*accumulate(data, initial=0)]
        return map(self.of, sums, accumulate(sums))

    def __call__(self, data: bytes) -> int:
        """The check of the bytes."""
        return deque(self.running(data), 1).pop()

    def of(self, total: Any, second: Any) -> Any:
        """The check of bytes with these two sums, numbers or arrays of numbers."""
        return (second % self.modulus << 8) + total % self.modulus


class Xor(Declared, frozen=True, dict=True):
    """The exclusive or of `start` and each byte."""

    start: Annotated[int, Meta(ge=0, le=255)] = 0
    bits: ClassVar[int] = 8

    @property
    def first(self) -> int:
        """The value before the first byte, as that of a Crc."""
        return self.start

    def running(self, data: bytes) -> Iterator[int]:
        """The exclusive or of the first 0, 1, 2, ... bytes, up to all."""
        return accumulate(data, operator.xor, initial=self.start)

    def __call__(self, data: bytes) -> int:
        """The exclusive or of the bytes."""
        return reduce(operator.xor, data, self.start)


class Crc(Declared, frozen=True, dict=True):
    """A cyclic redundancy check of `width` bits.

    `poly` is the polynomial without its highest term, most significant bit first, `init` the value
    before the first byte (as the register holds it where bits are not reflected), `xorout` what
    the result is combined with. With `reflected` each byte is taken lowest bit first, with `refout`
    the result has its lowest bit first; where it is not given, that is as `reflected` is.
    """

    width: Annotated[int, Meta(ge=1, le=32)]
    poly: Register
    init: Register = 0
    reflected: bool = False
    xorout: Register = 0
    refout: bool | None = None

    def __post_init__(self) -> None:
        if self.refout is None:
            force_setattr(self, "refout", self.reflected)
        super().__post_init__()
        for name in ("poly", "init", "xorout"):
            if getattr(self, name) >> self.width:
                raise WrongValue(
                    f"Crc.{name} is {getattr(self, name):#x}, it has {self.width} bits"
                )

    @property
    def bits(self) -> int:
        """Its width, as other checks call it."""
        return self.width

    @cached_property
    def spare(self) -> int:
        """The bits of the register below those of the check: it holds a byte at least.

        With `reflected` the check has the lowest bits, so that there are none below.
        """
        return 0 if self.reflected else max(0, 8 - self.width)

    @cached_property
    def table(self) -> tuple[int, ...]:
        """What each value of the byte that leaves the register adds to the rest of it."""
        found, bits = [], max(8, self.width)
        for byte in range(256):
            value = (_mirrored(byte, 8) if self.reflected else byte) << bits - 8
            for _ in range(8):
                value = value << 1 ^ (self.poly << bits - self.width) * (value >> bits - 1 & 1)
            value &= (1 << bits) - 1
            found.append(_mirrored(value, bits) if self.reflected else value)
        return tuple(found)

    @cached_property
    def first(self) -> int:
        """The register before the first byte."""
        return _mirrored(self.init, self.width) if self.reflected else self.init << self.spare

    def of(self, register: Any) -> Any:
        """The check for what the register holds, a number or an array of numbers."""
        register = register >> self.spare
        if self.refout is not self.reflected:
            register = _mirrored(register, self.width)
        return register ^ self.xorout

    def running(self, data: bytes) -> Iterator[int]:
        """The check of the first 0, 1, 2, ... bytes, up to all."""
        as_held = not self.spare and self.refout is self.reflected  # then it is sooner done
        return map(self.xorout.__xor__ if as_held else self.of, self._registers(data))

    def __call__(self, data: bytes) -> int:
        """The check of the bytes."""
        return int(self.of(deque(self._registers(data), 1).pop()))

    def _registers(self, data: bytes) -> Iterator[int]:
        """The register after the first 0, 1, 2, ... bytes, up to all."""
        table, bits = self.table, self.width + self.spare
        most, top = (1 << bits) - 1, bits - 8

        def upwards(value: int, byte: int) -> int:
            return value >> 8 ^ table[(value ^ byte) & 0xFF]

        def downwards(value: int, byte: int) -> int:
            return value << 8 & most ^ table[value >> top ^ byte]

        return accumulate(data, upwards if self.reflected else downwards, initial=self.first)


CheckFunction: TypeAlias = Sum | Fletcher | Xor | Crc


def _mirrored(value: Any, width: int) -> Any:
    """A number with its lowest bits in turned order, or an array of them."""
    return sum((value >> place & 1) << width - 1 - place for place in range(width))
