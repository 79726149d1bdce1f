"""Reads many numbers out of an array of bytes at once. Needs numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bilprov.spec.numbers import Number

WIDEST = 7
"""Bytes of a number whose values, signed or not, all fit into 64 bits with a sign."""


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
