"""Rhythm: fits periods to the places of mismatches.

A device that fails at every 64th frame fails no case twice in the same way. Its mismatches lie at
equal distances, counted in frames, faulty frames or frames of one kind. A fit is only a guess;
`runner.prediction` tries it. Between homing and a mismatch nothing needs to be fitted: each try of
a case begins with homing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import accumulate
from math import comb
from typing import NamedTuple

from bilprov.captures.text import ordinal
from bilprov.conformance.runner.tally import FAULT, FRAME, Place, counts
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
        kind = self.counter if self.counter in (FRAME, FAULT) else f"{self.counter} frame"
        return f"every {ordinal(self.period)} {kind}"


class _Fit(NamedTuple):
    chance: float
    rhythm: Rhythm


def fit(protocol: Protocol, kinds: Sequence[str], places: Sequence[Place]) -> list[Rhythm]:
    """The periods that mismatches at these places of the frames `kinds` may have, the best first.

    Each explains more of the places than chance does over all the periods that are looked at.
    """
    latest = [p for p in places if p.last - p.first < _WIDEST][-_LATEST:]
    if len(latest) < _FEWEST:
        return []
    met = {kind for p in latest for kind in kinds[p.first - 1 : p.last]}
    found: list[_Fit] = []
    for counter in (FRAME, FAULT, *sorted(met)):
        before = [0, *accumulate(counts(protocol, counter, kind) for kind in kinds)]
        spans = [(before[p.first - 1] + 1, before[p.last]) for p in latest]
        found += _fits(counter, sorted({(low, high) for low, high in spans if low <= high}))
    return [rhythm for _, rhythm in sorted(found)]


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
