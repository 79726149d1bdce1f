"""The settings of a serial line, and the time that a byte takes on it."""

from __future__ import annotations

from dataclasses import dataclass

from bilprov.captures.schemas import MS
from bilprov.spec.protocol import Protocol


@dataclass(frozen=True, slots=True)
class LineSettings:
    """The settings of a serial line: `baud` in bits/s, `parity` of N E O M S, `stopbits` 1 1.5 2.

    There are always 8 data bits. The defaults are the grammar's (`Protocol.line`). With `echo` what
    is sent comes back, as on a bus whose adapter hears itself. Raises ValueError, in one sentence,
    for any other value.
    """

    baud: int
    parity: str
    stopbits: float
    echo: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.baud, int) or self.baud < 1:
            raise ValueError(f"baud is {self.baud!r}, allowed are whole numbers from 1")
        if self.parity not in tuple("NEOMS"):
            raise ValueError(f"parity is {self.parity!r}, allowed are N, E, O, M and S")
        if self.stopbits not in (1, 1.5, 2):
            raise ValueError(f"stopbits is {self.stopbits!r}, allowed are 1, 1.5 and 2")

    @property
    def byte_time(self) -> int:
        """The time of one byte on the wire, in ns: start bit, 8 data, parity and stop bits."""
        bits = 1 + 8 + (self.parity != "N") + self.stopbits
        return round(bits * 1_000_000_000 / self.baud)

    def options(self, protocol: Protocol) -> str:
        """The options of a command that give these settings, as far as the grammar does not."""
        words = []
        for name in ("baud", "parity", "stopbits"):
            value = getattr(self, name)
            if value != getattr(protocol.line, name):
                words.append(f"--{name} {value}".removesuffix(".0"))
        return " ".join([*words, *(["--echo"] if self.echo else [])])

    def __str__(self) -> str:
        return f"{self.baud} 8{self.parity}{self.stopbits:g}"


def line_settings(
    protocol: Protocol,
    baud: int | None = None,
    parity: str | None = None,
    stopbits: float | None = None,
    *,
    echo: bool = False,
) -> LineSettings:
    """The given line settings; the grammar's own for each that is None. Raises ValueError."""
    line = protocol.line
    return LineSettings(
        baud=line.baud if baud is None else baud,
        parity=line.parity if parity is None else parity,
        stopbits=line.stopbits if stopbits is None else stopbits,
        echo=echo,
    )


def line_named(protocol: Protocol, text: str) -> LineSettings:
    """Parse line settings as `str(LineSettings)` writes them; the grammar's own if invalid."""
    baud, _, form = text.partition(" 8")
    try:
        return LineSettings(int(baud), form[:1], float(form[1:]))
    except ValueError:
        return line_settings(protocol)


def timeout_in_ns(protocol: Protocol, milliseconds: float | None) -> int:
    """The truncation time-out in ns, the grammar's own where none was given."""
    if milliseconds is None:
        milliseconds = protocol.timing.truncation_timeout
    return round(milliseconds * MS)
