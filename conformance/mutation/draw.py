"""Random draws that are the same for a seed on every machine and with every Python."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")


class Draw:
    """Random draws, made with `random()` alone because only it is the same in every Python."""

    def __init__(self, seed: int | str) -> None:
        self._next = random.Random(seed).random

    def below(self, end: int) -> int:
        """Return a whole number from 0 to `end` - 1."""
        return int(self._next() * end)

    def pick(self, choices: Sequence[T]) -> T:
        """Return one of the choices."""
        return choices[self.below(len(choices))]

    def between(self, low: int, high: int) -> int:
        """Return a whole number from `low` to `high`, both included."""
        return low + self.below(high - low + 1)
