"""Finds the fewest rules that set deviating exchanges apart from right ones.

A rule is a conjunction of literals, each about one feature. No rule takes in an exchange that was
seen to be right. First it is asked whether one rule explains all deviations (what all of them have
in common, as far as it is needed); else rules are made one after the other, each from a deviation
that none explains yet, so that it takes in as many others as it can.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bilprov.conformance.causes.exchanges import Exchange
from bilprov.conformance.causes.features import Feature, Literal, Rule

Mask = npt.NDArray[np.bool_]
Places = npt.NDArray[np.intp]

_BAGS = 1500
_SAMPLE = 3000
_MORE = 300
_THRESHOLDS = 24
_VALUES = 48
_WORDS = 3
_SEEDS = 6


class _Part(NamedTuple):
    """The values of a feature for some exchanges: numbers where `known`, codes of words else.

    The code of no word is -1.
    """

    known: Mask
    numbers: npt.NDArray[np.int64]
    codes: npt.NDArray[np.int16]


class _Column:
    """The values of a feature for all exchanges; each is taken when it is first asked for."""

    def __init__(self, feature: Feature, exchanges: Sequence[Exchange]) -> None:
        self.feature = feature
        self._exchanges = exchanges
        self._taken = np.zeros(len(exchanges), bool)
        self._known = np.zeros(len(exchanges), bool)
        self._numbers = np.zeros(len(exchanges), np.int64)
        self._codes = np.full(len(exchanges), -1, np.int16)
        self._code_of: dict[str, int] = {}

    def part(self, places: Places) -> _Part:
        """The values of the exchanges at these places."""
        missing = places[~self._taken[places]]
        if len(missing):
            self._take(np.unique(missing))
        return _Part(self._known[places], self._numbers[places], self._codes[places])

    def _take(self, places: Places) -> None:
        values = [self.feature.of(self._exchanges[place]) for place in places]
        code_of = self._code_of
        self._taken[places] = True
        self._known[places] = [isinstance(v, int) for v in values]
        self._numbers[places] = [v if isinstance(v, int) else 0 for v in values]
        self._codes[places] = [
            code_of.setdefault(v, len(code_of)) if isinstance(v, str) else -1 for v in values
        ]

    def mask(self, literal: Literal, part: _Part) -> Mask:
        """Return for which exchanges of a part the literal holds."""
        if literal.words:
            return np.isin(part.codes, [self._code_of[word] for word in literal.words])
        return np.asarray(part.known & literal.fits(part.numbers), bool)

    def _words(self, codes: npt.NDArray[np.int16]) -> tuple[str, ...]:
        return tuple(sorted(word for word, code in self._code_of.items() if code in codes))

    def literals(self, part: _Part, single: Mask) -> list[Literal]:
        """The literals that hold for some of a part; `single` are those alone in their bag."""
        feature = self.feature
        found = [Literal(feature, "is", word) for word in self._words(part.codes)]
        several = self._words(part.codes[single])
        if 1 < len(several) <= _WORDS:
            found.append(Literal(feature, "in", several))
        if not part.known.any():
            return found
        values, counts = np.unique(part.numbers[part.known], return_counts=True)
        alone = np.unique(part.numbers[single & part.known])
        # Of what is certain, both ends: a threshold beside them splits one cause.
        evenly = values[np.unique(np.linspace(0, len(values) - 1, _THRESHOLDS).astype(int))]
        steps = np.unique([*evenly, *alone[:1], *alone[-1:]])
        from_steps = [Literal(feature, "from", int(value)) for value in steps]
        if feature.grows:
            return found + from_steps
        common = values[np.argsort(-counts, kind="stable")][:_VALUES]
        found += [Literal(feature, "is", int(value)) for value in common]
        found += from_steps
        found += [Literal(feature, "to", int(value)) for value in steps]
        for bit in range(feature.bits):
            found += [Literal(feature, "bit", bit), Literal(feature, "no bit", bit)]
        if feature.counts:
            found += [Literal(feature, "every", period) for period in _periods(alone)]
        return found


def _periods(counts: npt.NDArray[np.int64]) -> list[tuple[int, int]]:
    """Periods in at least three different counts, each with the remainder that most of them have.

    That is what all of them have in common, and the commonest step, which a few others may break.
    """
    if len(counts) < 3:
        return []
    steps, times = np.unique(np.diff(counts), return_counts=True)
    periods = {int(np.gcd.reduce(steps)), int(steps[times.argmax()])} - {1}
    return [(period, int(np.bincount(counts % period).argmax())) for period in sorted(periods)]


def _add(rules: list[Rule], rule: Rule) -> None:
    """Add a rule to others, as one with another of which only the words of one feature differ.

    Neither takes in a right exchange, so the rule for the words of both takes in none.
    """
    for place, other in enumerate(rules):
        both = _with_the_words_of_both(other, rule)
        if both:
            rules[place] = both
            return
    rules.append(rule)


def _with_the_words_of_both(one: Rule, other: Rule) -> Rule | None:
    """The rule for what either of two rules takes in, None where it is not as simple as each."""
    if len(one) != len(other):
        return None
    apart = [(a, b) for a, b in zip(one, other, strict=True) if a != b]
    if len(apart) != 1:
        return None
    [(here, there)] = apart
    words = {*here.words, *there.words}
    if here.feature is not there.feature or not (here.words and there.words):
        return None
    merged = Literal(here.feature, "in", tuple(sorted(words)))
    return tuple(merged if literal is here else literal for literal in one)


class Table:
    """The features of a run's exchanges, each of which is taken once."""

    def __init__(self, features: Iterable[Feature], exchanges: Iterable[Exchange]) -> None:
        self._exchanges = list({id(exchange): exchange for exchange in exchanges}.values())
        self._places = {id(exchange): n for n, exchange in enumerate(self._exchanges)}
        self.columns = [_Column(feature, self._exchanges) for feature in features]

    def places(self, exchanges: Iterable[Exchange]) -> Places:
        """Return where these exchanges stand in the table."""
        return np.array([self._places[id(exchange)] for exchange in exchanges], np.intp)


class Learner:
    """Learns rules for some bags of exchanges against others that are right.

    Features that cost more than `most` are not used.
    """

    def __init__(
        self,
        table: Table,
        most: int,
        bags: Sequence[Sequence[Exchange]],
        right: Sequence[Exchange],
    ) -> None:
        self._columns = [column for column in table.columns if column.feature.cost <= most]
        drawn = random.Random(0)
        self.bags = sorted(drawn.sample(bags, min(len(bags), _BAGS)), key=len)
        sizes = [len(bag) for bag in self.bags]
        self._starts = np.cumsum([0, *sizes[:-1]])
        positive = table.places(e for bag in self.bags for e in bag)
        self._count = len(positive)
        single = np.repeat(np.array(sizes) == 1, sizes)
        parts = [column.part(positive) for column in self._columns]
        self._own = [
            column.literals(part, single) for column, part in zip(self._columns, parts, strict=True)
        ]
        self._literals = [literal for own in self._own for literal in own]
        self._column_of = [c for c, own in zip(self._columns, self._own, strict=True) for _ in own]
        self._costs = np.array([literal.cost for literal in self._literals])
        self._held = self._masks(positive)
        places = table.places(right)
        sample = np.array(drawn.sample(list(places), min(len(places), _SAMPLE)), np.intp)
        self._left = places[~np.isin(places, sample)]
        self._wrong = self._masks(sample)

    def _masks(self, places: Places) -> Mask:
        """For which of these exchanges each literal holds."""
        rows = []
        for column, own in zip(self._columns, self._own, strict=True):
            part = column.part(places)
            rows += [column.mask(literal, part) for literal in own]
        return np.array(rows, bool).reshape(len(rows), -1)

    def _bags_hit(self, held: npt.ArrayLike) -> Mask:
        """Which bags hold an exchange that is taken in, for each row."""
        return np.asarray(np.logical_or.reduceat(held, self._starts, axis=-1), bool)

    def _verified(self, chosen: Sequence[int]) -> bool:
        """Return whether a rule takes in no right exchange; those it does are added."""
        against = self._left
        for literal in sorted(chosen, key=lambda i: self._costs[i]):
            column = self._column_of[literal]
            against = against[column.mask(self._literals[literal], column.part(against))]
        against = against[:_MORE]
        if not len(against):
            return True
        self._left = self._left[~np.isin(self._left, against)]
        self._wrong = np.concatenate([self._wrong, self._masks(against)], axis=1)
        return False

    def _rule(self, chosen: Sequence[int]) -> Rule:
        return tuple(self._literals[i] for i in sorted(chosen, key=lambda i: self._costs[i]))

    def one_rule(self, share: float) -> Rule | None:
        """Return one rule that takes in this share of the bags, None where there is none."""
        while True:
            chosen = self._cover(share)
            if chosen is None:
                return None
            if self._verified(chosen):
                return self._rule(self._with_subject(chosen))

    def _with_subject(self, chosen: list[int]) -> list[int]:
        """The literals, with one that names the frame where all deviations have one in common."""
        if any(self._literals[i].feature.subject for i in chosen):
            return chosen
        for subject, literal in enumerate(self._literals):
            if not literal.feature.subject or literal.operator == "in":
                continue
            held = self._held[[*chosen, subject]].all(axis=0)
            if self._bags_hit(held).all():
                return [subject, *chosen]
        return chosen

    def _cover(self, share: float) -> list[int] | None:
        """The fewest literals that take in this share of the bags and no right exchange."""
        left = np.ones(self._wrong.shape[1], bool)
        taken = np.ones(self._count, bool)
        usable = np.arange(len(self._literals))
        chosen: list[int] = []
        while left.any():
            hit = self._bags_hit(self._held[usable] & taken)
            usable = usable[hit.mean(axis=1) >= share]
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
            taken &= self._held[pick]
        return self._pruned(chosen)

    def _pruned(self, chosen: list[int]) -> list[int]:
        for literal in sorted(chosen, key=lambda i: -self._costs[i]):
            rest = [i for i in chosen if i != literal]
            if rest and not self._wrong[rest].all(axis=0).any():
                chosen = rest
        return chosen

    def _some_rule(self, open_bags: Mask) -> list[int] | None:
        """The literals of a rule that takes in as many of these bags as it can."""
        bags = [int(i) for i in np.flatnonzero(open_bags)]
        draw = random.Random(len(bags))
        chosen_bags = draw.sample(bags, min(_SEEDS, len(bags)))
        drawn = [self._starts[bag] + draw.randrange(len(self.bags[bag])) for bag in chosen_bags]
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
        """A rule grown around one exchange, literal by literal, by the gain in information."""
        while True:
            usable = np.flatnonzero(self._held[:, seed])
            pos = np.ones(self._count, bool)
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
            if self._verified(chosen):
                return chosen

    def rules(self, most: int) -> list[Rule]:
        """Return rules that together take in as many bags as they can, the widest first."""
        open_bags = np.ones(len(self.bags), bool)
        found: list[Rule] = []
        while open_bags.any() and len(found) < most:
            chosen = self._some_rule(open_bags)
            if chosen is None:
                break
            _add(found, self._rule(chosen))
            open_bags &= ~self._bags_hit(self._held[chosen].all(axis=0))
        return found
