"""Works out the checks of many stretches of bytes at once. Needs numpy.

They have the values that the functions of `checks` give for each stretch by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bilprov.spec.checks import CheckFunction, Crc, Sum, Xor


class Checking:
    """A check of stretches of bytes, each in one or more pieces.

    `count` is the number of stretches. `take` counts a piece of each, `values` are the checks.
    """

    def __init__(self, function: CheckFunction, count: int) -> None:
        self._function = function
        first = {Sum: 0, Xor: getattr(function, "start", 0), Crc: getattr(function, "first", 0)}
        self._register = np.full(count, first[type(function)], np.int64)

    def take(
        self, data: NDArray[np.uint8], start: NDArray[np.int64], end: NDArray[np.int64]
    ) -> None:
        """Count the bytes of `data` from each start to its end."""
        if isinstance(self._function, Crc):
            self._register = _folded(self._function, self._register, data, start, end)
        elif isinstance(self._function, Sum):
            self._register += _between(np.cumsum(data, dtype=np.int64), np.subtract, start, end)
        else:
            upto = np.bitwise_xor.accumulate(data.astype(np.int64))
            self._register ^= _between(upto, np.bitwise_xor, start, end)

    @property
    def values(self) -> NDArray[np.int64]:
        """The checks of what was counted."""
        function = self._function
        if isinstance(function, Crc):
            return self._register ^ function.xorout
        if isinstance(function, Sum):
            values: NDArray[np.int64] = function.of(self._register)
            return values
        return self._register


def _between(
    upto: NDArray[np.int64],
    difference: Callable[..., Any],
    start: NDArray[np.int64],
    end: NDArray[np.int64],
) -> NDArray[np.int64]:
    """The sums from each start to its end, of the sums up to and with each byte."""
    upto = np.append(np.int64(0), upto)
    found: NDArray[np.int64] = difference(upto.take(end), upto.take(start))
    return found


def _folded(
    crc: Crc,
    register: NDArray[np.int64],
    data: NDArray[np.uint8],
    start: NDArray[np.int64],
    end: NDArray[np.int64],
) -> NDArray[np.int64]:
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
    kept = register << 8 & (1 << crc.width) - 1
    return kept ^ table.take(register >> crc.width - 8 ^ byte)


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
