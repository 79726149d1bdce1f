"""Noise on a line: flips one bit of a byte, drops or doubles bytes, at random with a seed.

The test suite's noisy devices and the fault-injecting line share it. It uses no port and no clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from random import Random
from typing import Literal

Harm = Literal["", "flipped", "dropped", "doubled"]

_BITS = 8


@dataclass(frozen=True, slots=True)
class Noise:
    """The probabilities (0 to 1) that a byte is flipped in one bit, dropped, or doubled.

    Raises ValueError for a probability outside 0 to 1, and if together they exceed 1.
    """

    flipped: float = 0.0
    dropped: float = 0.0
    doubled: float = 0.0

    def __post_init__(self) -> None:
        chances = (self.flipped, self.dropped, self.doubled)
        if not (all(chance >= 0 for chance in chances) and sum(chances) <= 1):  # nor is nan
            raise ValueError(
                f"the noise is {self.flipped:g} flipped, {self.dropped:g} dropped and "
                f"{self.doubled:g} doubled; each is 0 to 1, and all of them together at most 1"
            )

    def impair(self, byte: int, chance: Random) -> tuple[Harm, bytes]:
        """Apply the noise to a byte; return the effect ("" for none) and the bytes that arrive."""
        drawn = chance.random()
        if drawn < self.flipped:
            return "flipped", bytes([byte ^ 1 << chance.randrange(_BITS)])
        if drawn < self.flipped + self.dropped:
            return "dropped", b""
        if drawn < self.flipped + self.dropped + self.doubled:
            return "doubled", bytes([byte, byte])
        return "", bytes([byte])

    def over(self, data: bytes, chance: Random) -> bytes:
        """Apply the noise to each byte of `data` and return the bytes that arrive."""
        return b"".join(self.impair(byte, chance)[1] for byte in data)
