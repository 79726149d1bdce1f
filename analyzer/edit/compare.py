"""Compares two captures, frame by frame of the host: what differs in frames, answers, latencies."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, Literal

from bilprov.analyzer.edit.alignment import aligned
from bilprov.analyzer.edit.exchanges import Exchange
from bilprov.captures.schemas import MS

TOLERANCE: Final = 20 * MS
"""Ns by which two latencies may differ: USB adapters hold bytes back for up to 16 ms."""

LISTED: Final = 100  # differences that are kept

Kind = Literal["only_a", "only_b", "answer", "latency", "unasked"]
KINDS: Final[tuple[Kind, ...]] = ("only_a", "only_b", "answer", "latency", "unasked")


@dataclass(frozen=True, slots=True)
class Difference:
    """One difference, and the exchanges in which it is; None in the capture that has none."""

    kind: Kind
    first: Exchange | None
    second: Exchange | None


class Latencies:
    """How some latencies are spread, in memory that does not grow: to three digits."""

    def __init__(self) -> None:
        self.count = 0
        self._counts: Counter[int] = Counter()

    def add(self, latency: int) -> None:
        """Count a latency (ns)."""
        self.count += 1
        size = len(str(abs(latency)))
        self._counts[round(latency, min(0, 3 - size))] += 1

    def percentile(self, share: float) -> int:
        """The latency (ns) that so many percent of them do not exceed; there must be some."""
        left = math.ceil(self.count * share / 100)
        for latency, count in sorted(self._counts.items()):
            left -= count
            if left <= 0:
                return latency
        raise ValueError("there are no latencies")


@dataclass(slots=True)
class Comparison:
    """What two captures have in common, and where they differ.

    `same` counts the frames that both have, `judged` those of them whose answers were compared, and
    `unknown` those of which only one capture tells what was answered. `differences` counts by kind;
    the first ones are `listed`. `latencies` are those of both captures, by the name of the
    instruction. Latencies may differ by `tolerance` (ns).
    """

    tolerance: int
    same: int = 0
    judged: int = 0
    unknown: int = 0
    differences: Counter[Kind] = field(default_factory=Counter)
    listed: list[Difference] = field(default_factory=list)
    latencies: dict[str, tuple[Latencies, Latencies]] = field(default_factory=dict)

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
        if (one.byte if one else None) != (other.byte if other else None):
            self._differs("answer", first, second)
        elif one and other and abs((one.latency or 0) - (other.latency or 0)) > self.tolerance:
            self._differs("latency", first, second)

    def _measure(self, side: int, exchange: Exchange) -> None:
        frame, answer = exchange.frame, exchange.answer
        if frame is None or frame.judgement is None or answer is None or answer.latency is None:
            return
        judgement = frame.judgement
        known = judgement.instruction
        name = known.name if known else f"unused {judgement.id}"
        if name not in self.latencies:
            self.latencies[name] = Latencies(), Latencies()
        self.latencies[name][side].add(answer.latency)

    def _differs(self, kind: Kind, first: Exchange | None, second: Exchange | None) -> None:
        self.differences[kind] += 1
        if len(self.listed) < LISTED:
            self.listed.append(Difference(kind, first, second))


def compared(
    first: Iterator[Exchange], second: Iterator[Exchange], tolerance: int = TOLERANCE
) -> Comparison:
    """Compare the exchanges of two captures; latencies may differ by `tolerance` (ns)."""
    comparison = Comparison(tolerance)
    for pair in aligned(first, second):
        comparison.pair(*pair)
    return comparison
