"""Compares two captures, frame by frame of the host: what differs in frames, answers, latencies."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Final, Literal

from bilprov.analyzer.edit.alignment import aligned
from bilprov.analyzer.edit.exchanges import Exchange
from bilprov.analyzer.totals.latencies import Latencies, Spread
from bilprov.captures.schemas import MS
from bilprov.spec.protocol import Protocol

TOLERANCE: Final = 20 * MS
"""Ns by which two latencies may differ: USB adapters hold bytes back for up to 16 ms."""

LISTED: Final = 100  # differences that are kept
_AT_ONCE: Final = 4096  # latencies

Kind = Literal["only_a", "only_b", "answer", "latency", "unasked"]
KINDS: Final[tuple[Kind, ...]] = ("only_a", "only_b", "answer", "latency", "unasked")


@dataclass(frozen=True, slots=True)
class Difference:
    """One difference, and the exchanges in which it is; None in the capture that has none."""

    kind: Kind
    first: Exchange | None
    second: Exchange | None


@dataclass(slots=True)
class Comparison:
    """What two captures have in common, and where they differ.

    `same` counts the frames that both have, `judged` those of them whose answers were compared, and
    `unknown` those of which only one capture tells what was answered. `differences` counts by kind;
    the first ones are `listed`. Latencies may differ by `tolerance` (ns).
    """

    protocol: Protocol
    tolerance: int
    same: int = 0
    judged: int = 0
    unknown: int = 0
    differences: Counter[Kind] = field(default_factory=Counter)
    listed: list[Difference] = field(default_factory=list)
    _latencies: tuple[_Measured, _Measured] = field(init=False)

    def __post_init__(self) -> None:
        self._latencies = (_Measured(self.protocol), _Measured(self.protocol))

    def pair(self, first: Exchange | None, second: Exchange | None) -> None:
        """Add the next exchange, of both captures or of one alone."""
        for side, exchange in enumerate((first, second)):
            if exchange is not None:
                self._measure(side, exchange)
        if first is None or second is None:
            self._differs("only_a" if second is None else "only_b", first, second)
            return
        self.same += first.frame is not None
        if first.told and second.told:
            self.judged += 1
            self._answers(first, second)
        elif first.told or second.told:
            self.unknown += 1
        if first.unasked != second.unasked:
            self._differs("unasked", first, second)

    @property
    def exit(self) -> int:
        """1 if anything differs, 3 if answers cannot be compared at all, else 0."""
        if self.differences:
            return 1
        return 3 if self.unknown and not self.judged else 0

    def _answers(self, first: Exchange, second: Exchange) -> None:
        one, other = first.answer, second.answer
        if (one.data if one else None) != (other.data if other else None):
            self._differs("answer", first, second)
        elif one and other and abs((one.latency or 0) - (other.latency or 0)) > self.tolerance:
            self._differs("latency", first, second)

    def _measure(self, side: int, exchange: Exchange) -> None:
        frame, answer = exchange.frame, exchange.answer
        if frame is None or frame.judgement is None or answer is None or answer.latency is None:
            return
        known = frame.judgement.instruction
        unused = f"unused {frame.judgement.id}" if self.protocol.plain else "unused"
        self._latencies[side].add(known.name if known else unused, answer.latency)

    def latencies(self) -> dict[str, tuple[Spread | None, Spread | None]]:
        """How the latencies of each capture are spread, by the name of the instruction."""
        first, second = (measured.spreads() for measured in self._latencies)
        return {name: (first.get(name), second.get(name)) for name in sorted({*first, *second})}

    def _differs(self, kind: Kind, first: Exchange | None, second: Exchange | None) -> None:
        self.differences[kind] += 1
        if len(self.listed) < LISTED:
            self.listed.append(Difference(kind, first, second))


class _Measured:
    """The latencies of one capture by name of the instruction, counted many at a time."""

    def __init__(self, protocol: Protocol) -> None:
        self._counted = defaultdict[str, Latencies](partial(Latencies, protocol.timing))
        self._waiting = defaultdict[str, list[int]](list)

    def add(self, name: str, latency: int) -> None:
        waiting = self._waiting[name]
        waiting.append(latency)
        if len(waiting) == _AT_ONCE:
            self._count(name)

    def spreads(self) -> dict[str, Spread | None]:
        for name in self._waiting:
            self._count(name)
        return {name: latencies.spread() for name, latencies in self._counted.items()}

    def _count(self, name: str) -> None:
        self._counted[name].add(self._waiting[name])
        self._waiting[name].clear()


def compared(
    first: Iterator[Exchange],
    second: Iterator[Exchange],
    protocol: Protocol,
    tolerance: int = TOLERANCE,
) -> Comparison:
    """Compare the exchanges of two captures; latencies may differ by `tolerance` (ns)."""
    comparison = Comparison(protocol, tolerance)
    for pair in aligned(first, second):
        comparison.pair(*pair)
    return comparison
