"""How a serial line is set, and how long a byte takes on it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LineSettings:
    """How a serial line is set: `baud` in bits/s, `parity` one of N E O M S, `stopbits` 1 1.5 2.

    Raises ValueError, in one sentence, for anything else. Always 8 data bits. What
    a line is where nobody says it is the grammar's to tell (`Protocol.line`).
    """

    baud: int
    parity: str
    stopbits: float

    def __post_init__(self) -> None:
        if self.baud < 1:
            raise ValueError(f"baud is {self.baud}, allowed are numbers from 1")
        if self.parity not in tuple("NEOMS"):
            raise ValueError(f"parity is {self.parity!r}, allowed are N, E, O, M and S")
        if self.stopbits not in (1, 1.5, 2):
            raise ValueError(f"stopbits is {self.stopbits}, allowed are 1, 1.5 and 2")

    @property
    def byte_time(self) -> int:
        """How long one byte takes on the wire, in ns: start, 8 data, parity and stop bits."""
        bits = 1 + 8 + (self.parity != "N") + self.stopbits
        return round(bits * 1_000_000_000 / self.baud)

    def __str__(self) -> str:
        return f"{self.baud} 8{self.parity}{self.stopbits:g}"
