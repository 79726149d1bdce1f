"""Finds the fewest rules that set deviating exchanges apart from right ones.

A rule is a conjunction of literals, each about one feature. No rule takes in an exchange that was
seen to be right. First it is asked whether one rule explains all deviations (what all of them have
in common, as far as it is needed); else rules are made one after the other, each from a deviation
that none explains yet, so that it takes in as many others as it can.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from bilprov.conformance.causes.exchanges import Exchange
from bilprov.conformance.causes.features import Feature
from bilprov.conformance.causes.rules import Literal, Rule, matches

Mask = npt.NDArray[np.bool_]

_SAMPLE = 3000
_MORE = 300
_THRESHOLDS = 24
_VALUES = 48
_SEEDS = 6


class Column:
    """The values of a feature for many exchanges, on which literals are evaluated at once."""

    def __init__(self, feature: Feature, exchanges: Sequence[Exchange]) -> None:
        self.feature = feature
        self.values = [feature.of(exchange) for exchange in exchanges]
        numbers = [v if isinstance(v, int) else None for v in self.values]
        self.known = np.array([n is not None for n in numbers], bool)
        self.numbers = np.array([n or 0 for n in numbers], np.int64)
        self._words = np.array([v if isinstance(v, str) else "" for v in self.values])

    def mask(self, literal: Literal) -> Mask:
        """Return for which exchanges the literal holds."""
        if isinstance(literal.value, str):
            return np.asarray(self._words == literal.value, bool)
        return np.asarray(self.known & _fits(self.numbers, literal), bool)


def _fits(numbers: npt.NDArray[np.int64], literal: Literal) -> npt.NDArray[np.bool_]:
    operator, value = literal.operator, literal.value
    if isinstance(value, tuple):
        return np.asarray(numbers % value[0] == value[1])
    assert isinstance(value, int)
    if operator == "is":
        return np.asarray(numbers == value)
    if operator == "from":
        return np.asarray(numbers >= value)
    if operator == "to":
        return np.asarray(numbers <= value)
    return np.asarray((np.abs(numbers) >> value & 1 == 1) == (operator == "bit"))


class _Learner:
    """Learns rules for some bags of exchanges against others that are right."""

    def __init__(
        self,
        features: Sequence[Feature],
        bags: Sequence[Sequence[Exchange]],
        right: Sequence[Exchange],
    ) -> None:
        self.features = features
        self.bags = sorted(bags, key=len)[:1500]
        self._right = right
        drawn = random.Random(0)
        sample = list(right) if len(right) <= _SAMPLE else drawn.sample(right, _SAMPLE)
        self._sampled = set(map(id, sample))
        self._positive = [e for bag in self.bags for e in bag]
        self._starts = np.cumsum([0, *(len(bag) for bag in self.bags[:-1])])
        self._columns = [Column(f, self._positive) for f in features]
        self._literals = [
            literal for column in self._columns for literal in _literals(column, self._single())
        ]
        self._costs = np.array([literal.feature.cost for literal in self._literals])
        self._held = self._masks(self._columns)
        self._wrong = np.zeros((len(self._literals), 0), bool)
        self._add(sample)

    def _single(self) -> Mask:
        """Which of the positive exchanges are alone in their bag."""
        return np.concatenate([np.full(len(bag), len(bag) == 1) for bag in self.bags])

    def _masks(self, columns: Sequence[Column]) -> Mask:
        by_name = {column.feature.name: column for column in columns}
        rows = [by_name[literal.feature.name].mask(literal) for literal in self._literals]
        return np.array(rows, bool).reshape(len(rows), -1)

    def _add(self, right: Sequence[Exchange]) -> None:
        columns = [Column(feature, right) for feature in self.features]
        self._wrong = np.concatenate([self._wrong, self._masks(columns)], axis=1)

    def _bags_hit(self, held: npt.ArrayLike) -> Mask:
        """Which bags hold an exchange that is taken in, for each row."""
        return np.asarray(np.logical_or.reduceat(held, self._starts, axis=-1), bool)

    def verified(self, chosen: list[int]) -> bool:
        """Return whether a rule takes in no right exchange; those it does are added."""
        rule = self.rule(chosen)
        against = []
        for exchange in self._right:
            if id(exchange) not in self._sampled and matches(rule, exchange):
                against.append(exchange)
                if len(against) >= _MORE:
                    break
        if not against:
            return True
        self._sampled.update(map(id, against))
        self._add(against)
        return False

    def rule(self, chosen: Sequence[int]) -> Rule:
        return tuple(self._literals[i] for i in sorted(chosen, key=lambda i: self._costs[i]))

    def one_rule(self, share: float) -> list[int] | None:
        """The literals of a rule that takes in this share of the bags, None if there is none."""
        while True:
            hit = self._bags_hit(self._held)
            common = np.flatnonzero(hit.mean(axis=1) >= share)
            chosen = self._cover(common)
            if chosen is None:
                return None
            taken = self._bags_hit(self._held[chosen].all(axis=0))
            if taken.mean() < share:
                return None
            if self.verified(chosen):
                return self._with_subject(chosen)

    def _with_subject(self, chosen: list[int]) -> list[int]:
        """The literals, with one that names the frame where all deviations have one in common."""
        subjects = [i for i, one in enumerate(self._literals) if one.feature.subject]
        if any(i in chosen for i in subjects):
            return chosen
        for subject in subjects:
            held = self._held[[*chosen, subject]].all(axis=0)
            if self._bags_hit(held).all():
                return [subject, *chosen]
        return chosen

    def _cover(self, usable: npt.NDArray[np.intp]) -> list[int] | None:
        """The fewest of these literals of which no right exchange fulfils all."""
        left = np.ones(self._wrong.shape[1], bool)
        chosen: list[int] = []
        while left.any():
            if not len(usable):
                return None
            excluded = (~self._wrong[usable][:, left]).sum(axis=1)
            best = excluded.max()
            if not best:
                return None
            close = usable[excluded >= best * 0.98]
            pick = int(close[np.argmin(self._costs[close])])
            chosen.append(pick)
            left &= self._wrong[pick]
        return self._pruned(chosen)

    def _pruned(self, chosen: list[int]) -> list[int]:
        for literal in sorted(chosen, key=lambda i: -self._costs[i]):
            rest = [i for i in chosen if i != literal]
            if rest and not self._wrong[rest].all(axis=0).any():
                chosen = rest
        return chosen

    def some_rule(self, open_bags: Mask) -> list[int] | None:
        """The literals of a rule that takes in as many of these bags as it can."""
        seeds = [int(i) for i in np.flatnonzero(open_bags)]
        drawn = random.Random(len(seeds)).sample(seeds, min(_SEEDS, len(seeds)))
        best: tuple[float, list[int]] | None = None
        for seed in drawn:
            chosen = self._grown(seed, open_bags)
            if chosen is None:
                continue
            taken = self._bags_hit(self._held[chosen].all(axis=0)) & open_bags
            score = taken.sum() - len(chosen) * 0.1
            if best is None or score > best[0]:
                best = score, chosen
        return best[1] if best else None

    def _grown(self, seed: int, open_bags: Mask) -> list[int] | None:
        """A rule grown around one bag, literal by literal, by the gain in information."""
        while True:
            first = int(self._starts[seed])
            usable = np.flatnonzero(self._held[:, first])
            pos = np.ones(len(self._positive), bool)
            neg = np.ones(self._wrong.shape[1], bool)
            chosen: list[int] = []
            while neg.any() and len(chosen) < 6:
                p0, n0 = int(open_bags.sum()), int(neg.sum())
                held = self._held[usable] & pos
                p1 = (self._bags_hit(held) & open_bags).sum(axis=1)
                n1 = (self._wrong[usable] & neg).sum(axis=1)
                now = (self._bags_hit(pos[None, :]) & open_bags).sum()
                base = math.log2(now / (now + n0)) if now else 0.0
                gain = p1 * (
                    np.log2(p1 / (p1 + n1), where=p1 > 0, out=np.full(len(p1), -99.0)) - base
                )
                gain -= self._costs[usable] * 1e-3 * max(p0, 1)
                pick = int(usable[np.argmax(gain)])
                if pick in chosen or gain.max() <= 0:
                    return None
                chosen.append(pick)
                pos &= self._held[pick]
                neg &= self._wrong[pick]
            if neg.any():
                return None
            chosen = self._pruned(chosen)
            if self.verified(chosen):
                return chosen

    def taken(self, chosen: Sequence[int]) -> Mask:
        """Which bags a rule takes in."""
        return self._bags_hit(self._held[list(chosen)].all(axis=0))


def _literals(column: Column, single: Mask) -> list[Literal]:
    feature, found = column.feature, []
    words = {v for v in column.values if isinstance(v, str)}
    found += [Literal(feature, "is", word) for word in sorted(words)]
    if not column.known.any():
        return found
    numbers = column.numbers[column.known]
    values, counts = np.unique(numbers, return_counts=True)
    common = values[np.argsort(-counts, kind="stable")][:_VALUES]
    found += [Literal(feature, "is", int(value)) for value in common]
    steps = values[np.unique(np.linspace(0, len(values) - 1, _THRESHOLDS).astype(int))]
    found += [Literal(feature, "from", int(value)) for value in steps]
    found += [Literal(feature, "to", int(value)) for value in steps]
    for bit in range(feature.bits):
        found += [Literal(feature, "bit", bit), Literal(feature, "no bit", bit)]
    if feature.counts and (single & column.known).sum() > 2:
        alone = np.unique(column.numbers[single & column.known])
        period = int(np.gcd.reduce(np.diff(alone))) if len(alone) > 2 else 0
        if period > 1:
            found.append(Literal(feature, "every", (period, int(alone[0]) % period)))
    return found


def one_rule(
    features: Sequence[Feature],
    bags: Sequence[Sequence[Exchange]],
    right: Sequence[Exchange],
    share: float = 1.0,
) -> Rule | None:
    """Return one rule that takes in this share of the bags, None where there is none."""
    learner = _Learner(features, bags, right)
    chosen = learner.one_rule(share)
    return None if chosen is None else learner.rule(chosen)


def rules(
    features: Sequence[Feature],
    bags: Sequence[Sequence[Exchange]],
    right: Sequence[Exchange],
    most: int,
) -> list[Rule]:
    """Return rules that together take in as many bags as they can, the widest first."""
    learner = _Learner(features, bags, right)
    open_bags = np.ones(len(learner.bags), bool)
    found: list[Rule] = []
    while open_bags.any() and len(found) < most:
        chosen = learner.some_rule(open_bags)
        if chosen is None:
            break
        found.append(learner.rule(chosen))
        open_bags &= ~learner.taken(chosen)
    return found
