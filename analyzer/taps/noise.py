"""What a bad line does to a byte: it is flipped in one bit, dropped or doubled, by seeded chance.

No port, no clock: bytes and a source of chance in, bytes out. The suite's noisy devices and the
fault-injecting line share it.
"""

from __future__ import annotations

from dataclasses import dataclass
from random import Random
from typing import Literal

Harm = Literal["", "flipped", "dropped", "doubled"]

_BITS = 8


@dataclass(frozen=True, slots=True)
class Noise:
    """How likely (0 to 1) a byte on the line is flipped in one bit, dropped, or doubled.

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

    def strike(self, byte: int, chance: Random) -> tuple[Harm, bytes]:
        """Return what happens to one byte ("" for nothing), and what arrives of it."""
        drawn = chance.random()
        if drawn < self.flipped:
            return "flipped", bytes([byte ^ 1 << chance.randrange(_BITS)])
        if drawn < self.flipped + self.dropped:
            return "dropped", b""
        if drawn < self.flipped + self.dropped + self.doubled:
            return "doubled", bytes([byte, byte])
        return "", bytes([byte])

    def over(self, data: bytes, chance: Random) -> bytes:
        """What arrives of the bytes that were sent."""
        return b"".join(self.strike(byte, chance)[1] for byte in data)
