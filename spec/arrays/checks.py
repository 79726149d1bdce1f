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
            most = (1 << function.bits) - 1
            return self._register & most ^ (most if function.complement else 0)
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
    stand in front, so that those which still have a byte are the first ones.
    """
    table, shift = _table(crc), crc.width - 8
    size = end - start
    order = np.argsort(-size, kind="stable")
    at, value = start[order], register[order]
    still = np.searchsorted(-size[order], -np.arange(int(size.max(initial=0))), "left")
    for place, count in enumerate(still.tolist()):
        byte, rest = data.take(at[:count] + place), value[:count]
        if crc.reflected:
            value[:count] = rest >> 8 ^ table.take((rest ^ byte) & 0xFF)
        else:
            kept = rest << 8 & (1 << crc.width) - 1
            value[:count] = kept ^ table.take(rest >> shift ^ byte)
    found = np.empty_like(value)
    found[order] = value
    return found


@lru_cache(maxsize=16)
def _table(crc: Crc) -> NDArray[np.int64]:
    return np.array(crc.table, np.int64)
