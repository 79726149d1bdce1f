"""An experiment on a device's choice of an open point, and its finding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from bilprov.analyzer.client.operations import Procedure
from bilprov.conformance.runner.run import Run


@dataclass(frozen=True, slots=True)
class Finding:
    """What one experiment showed: (point, choice) pairs, "" for a choice that could not be told.

    `fault` says what no reading allows, "" for nothing; `coarse` why the link is too slow to tell.
    `actual` and `heard`, the answers as (time in ns, code), are for the report and do not count
    when two findings are compared.
    """

    words: tuple[tuple[str, str], ...]
    expected: str
    actual: str = field(compare=False)
    fault: str = ""
    heard: tuple[tuple[int, int], ...] = field(default=(), compare=False)
    coarse: str = ""

    def fits(self, other: Finding) -> bool:
        """Whether both show the same, as far as both could tell."""
        pairs = zip(self.words, other.words, strict=True)
        alike = all(a == b or (a[0] == b[0] and "" in (a[1], b[1])) for a, b in pairs)
        return alike and (self.fault, self.coarse) == (other.fault, other.coarse)

    @property
    def told(self) -> int:
        """How many choices could be told."""
        return sum(word != "" for _, word in self.words)


@dataclass(frozen=True, slots=True)
class Experiment:
    """One experiment: the open points it is about, and the procedure, for a homed line.

    `sees` if it needs looks, `safety` if it is about the stop, `long` if it is repeated only where
    necessary, `timed` if it rests on pauses near the time-out, which in real time may come out
    longer at the device, `cut` if its frame is cut short, `option` the option of `--allow` without
    which it is not made.
    """

    name: str
    points: tuple[str, ...]
    requirement: str
    make: Callable[[Run], Procedure[Finding]]
    stimulus: bytes = b""
    sees: bool = False
    safety: bool = False
    long: bool = False
    timed: bool = False
    cut: bool = False
    option: str = ""
