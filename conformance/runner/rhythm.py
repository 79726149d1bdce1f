"""Rhythm: fits periods to the places of mismatches.

A device that fails at every 64th frame fails no case twice in the same way. Its mismatches lie at
equal distances, counted in frames, faulty or valid ones, or those of one kind or ID. A fit is only
a guess; `runner.prediction` tries it. Between homing and a mismatch nothing needs to be fitted:
each try of a case begins with homing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import accumulate
from math import comb
from typing import NamedTuple

from bilprov.captures.text import ordinal
from bilprov.conformance.runner.tally import FAULT, FRAME, VALID, Place, Sent, counters
from bilprov.spec.protocol import Protocol

LONGEST = 2048
"""The longest period that is fitted, in frames counted."""
_FEWEST = 3  # places that a period explains; two are at equal distances always
_WIDEST = 64  # frames that a mismatch may be of, to be fitted
_LATEST = 40  # places that are fitted
# Limits for a run: attempts at predictions, frames sent to get there, fits.
_ATTEMPTS, _FRAMES, _FITS = 24, 40_000, 24


class Rhythm(NamedTuple):
    """Each so-manyth (`period`) of the frames that the counter counts (`runner.tally`)."""

    counter: str
    period: int

    @property
    def words(self) -> str:
        """As in a sentence: `every 64th faulty frame`."""
        return f"every {ordinal(self.period)} {self.counter}"


class _Fit(NamedTuple):
    chance: float
    rhythm: Rhythm


def fit(protocol: Protocol, sent: Sequence[Sent], places: Sequence[Place]) -> list[Rhythm]:
    """The period by each counter that mismatches at these places may have, the best first.

    `sent` are the frames. Each period explains more of the places than chance does over all the
    periods that are looked at.
    """
    latest = [p for p in places if p.last - p.first < _WIDEST][-_LATEST:]
    if len(latest) < _FEWEST:
        return []
    counted = {one: counters(protocol, one) for one in set(sent)}
    near = {one for p in latest for one in sent[p.first - 1 : p.last]}
    met = {FRAME, FAULT, VALID, *(counter for one in near for counter in counted[one])}
    found: list[_Fit] = []
    for counter in sorted(met):
        before = [0, *accumulate(counter in counted[one] for one in sent)]
        spans = [(before[p.first - 1] + 1, before[p.last]) for p in latest]
        found += _fits(counter, sorted({(low, high) for low, high in spans if low <= high}))
    best: dict[str, Rhythm] = {}
    for _, rhythm in sorted(found):
        best.setdefault(rhythm.counter, rhythm)
    return list(best.values())


def _fits(counter: str, spans: Sequence[tuple[int, int]]) -> Iterator[_Fit]:
    """The periods of one counter that explain intervals of its numbers."""
    if len(spans) < _FEWEST:
        return
    longest = min(LONGEST, spans[-1][1] - spans[0][0])
    for period in range(2, longest + 1):
        narrow = [(low, high) for low, high in spans if 2 * (high - low + 1) <= period]
        if len(narrow) < _FEWEST:
            continue
        hits = Counter(at % period for low, high in narrow for at in range(low, high + 1))
        ((_, most),) = hits.most_common(1)
        if most < _FEWEST:
            continue
        share = sum(high - low + 1 for low, high in narrow) / len(narrow) / period
        # By chance: of this period's places, and of all the periods.
        chance = longest * period * at_least(most, len(narrow), share)
        if chance < 1:
            yield _Fit(chance, Rhythm(counter, period))


def at_least(count: int, tries: int, chance: float) -> float:
    """The probability that at least `count` of `tries` happen, each with probability `chance`."""
    return sum(
        comb(tries, n) * chance**n * (1 - chance) ** (tries - n) for n in range(count, tries + 1)
    )


class Rhythms:
    """The rhythms that a run has proven, and what it has spent on finding them."""

    def __init__(self) -> None:
        self.proven: list[Rhythm] = []
        self.attempts = 0
        self.frames = 0
        self.fits = 0

    @property
    def spent(self) -> bool:
        """Whether a run has done enough for it."""
        return self.attempts >= _ATTEMPTS or self.frames >= _FRAMES or self.fits >= _FITS
