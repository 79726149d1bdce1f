"""The causes of a run's failures: a rule, what goes wrong under it, and the cases it explains."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cache

from bilprov.conformance.causes.exchanges import (
    ANSWER,
    MOTION,
    Bag,
    Deviation,
    Exchange,
    Exchanges,
    Known,
)
from bilprov.conformance.causes.features import Feature, Rule, matches
from bilprov.conformance.causes.learner import Learner, Table
from bilprov.conformance.causes.relations import (
    Effect,
    Relation,
    Value,
    relations,
    resuming,
)

_EFFECTS, _RULES = 12, 4
"""Different deviations that are explained, those seen most, and rules for each of them, at most."""
_LITERALS = 4
"""Conditions of one rule for everything that went wrong; with more it describes two causes."""
_FEW_LEFT = 0.1
"""The share of the deviations of an effect that one rule for it and others may leave out."""
_FEW, _FEW_SHARE = 4, 0.15
"""Cases, and their share of the widest cause's, that may be what another cause brings about."""
_TAKEN = 2
"""Causes that are taken as known in turn, at most."""
_THIN = 5
"""What the condition of a cause may cost for each of its cases."""
_SIMPLE = 4
"""What a condition costs that names a frame and a value."""
_BACK = 64
"""Frames up to a deviation at which that other cause is looked for."""
TIERS = (1, 2, 4, 6)
"""The costs up to which features are tried: those that explain most simply come first."""


@dataclass(slots=True)
class Cause:
    """A rule, the effects that it explains, and deviations that these have brought about.

    `moves_on` is whether the device did not stop behind a wrong answer.
    """

    rule: Rule
    effects: list[Effect] = field(default_factory=list)
    consequences: list[Bag] = field(default_factory=list)
    moves_on: bool = False

    @property
    def exchanges(self) -> list[Exchange]:
        """The exchanges that the rule takes in among those that may have caused a deviation."""
        groups = [group for effect in self.effects for group in effect.groups]
        return [e for group in groups for e in group if matches(self.rule, e)]

    @property
    def cases(self) -> set[str]:
        """The ids of the cases that it explains."""
        consequences = {bag.exchanges[-1].case for bag in self.consequences}
        return consequences | {e.case for e in self.exchanges}

    @property
    def watched(self) -> int:
        """How long (ns) after a frame all that it does has shown."""
        return max(max(e.watched, e.answered) for e in self.exchanges)

    @property
    def disturbs(self) -> bool:
        """Whether what it does may show at later frames, too."""
        return not all(effect.bags[0].deviation.right_code for effect in self.effects)

    @property
    def kinds(self) -> set[Deviation | tuple[str, str]]:
        """The deviations that it explains: of a motion each, else the facets and how they do."""
        found = [bag.deviation for effect in self.effects for bag in effect.bags]
        return {one if one.facet == MOTION else one[:2] for one in found}

    def explains(self, bag: Bag) -> bool:
        """Return whether a deviation is one of its own."""
        alike = (bag.deviation[:2] == (e.relation.facet, e.relation.how) for e in self.effects)
        return any(alike) and any(matches(self.rule, e) for e in bag.exchanges)

    def made(self, exchange: Exchange) -> dict[str, Value]:
        """Return what the device makes of an exchange, by facet, None where that is not known."""
        made: dict[str, Value] = {}
        if matches(self.rule, exchange):
            for relation in (effect.relation for effect in self.effects):
                predict = relation.predict if relation.how == "wrong" else None  # else for a while
                value = predict(exchange) if predict else None
                made[relation.facet] = value if made.get(relation.facet, value) == value else None
        made.pop(ANSWER, None)
        return made

    @property
    def takes_data(self) -> bool:
        """Whether the device takes data bytes for frames: then others begin elsewhere, too."""
        return any(effect.takes_data for effect in self.effects)

    def misread(self, exchanges: Iterable[Exchange]) -> list[Exchange]:
        """Return the frames whose data bytes the device takes for frames, if that is the cause."""
        return [e for e in exchanges if matches(self.rule, e)] if self.takes_data else []

    def foresees(self, exchange: Exchange) -> bool:
        """Return whether it takes in an exchange and would show there."""
        differs = any(effect.relation.differs(exchange) for effect in self.effects)
        return differs and matches(self.rule, exchange)


def fewest_causes(
    features: Sequence[Feature],
    exchanges: Exchanges,
    failed: Set[str],
    again: Callable[[Known, Container[int]], Exchanges],
) -> list[Cause]:
    """Find the fewest and simplest causes of the deviations in the failed cases.

    What a device makes of a frame may stay unseen, so that a second fault shows in another state
    than is expected, or does not show. So where there are several causes, or one leaves failures,
    the simplest that nothing contradicts are taken as known in turn: `again` gives the exchanges
    with what the device is then known to make of them. Which bytes of those are frames changes
    where it takes data for such.
    """

    def found(of: Exchanges, bags: Iterable[Bag]) -> list[Cause]:
        causes = find_causes(features, of.all, bags, failed)
        return [cause for cause in causes if any(case in failed for case in cause.cases)]

    causes = found(exchanges, exchanges.bags)
    if len(causes) == 1 and failed <= _cases(causes):
        return causes
    for cause in _certain(causes)[:_TAKEN]:
        misread = cause.misread(exchanges.all)
        known = again(cause.made, {exchange.step.frame[0] for exchange in misread})
        others_bags = [bag for bag in known.bags if not cause.explains(bag)]
        others = found(known, others_bags)
        left = {bag.exchanges[0].case for bag in others_bags}
        within = {exchange.case for exchange in misread}
        solution = _with_consequences(cause, others, exchanges.bags, left, within)
        more = len(_cases(solution) & failed) - len(_cases(causes) & failed)
        if more >= 0 and (_complexity(solution), -more) < (_complexity(causes), 0):
            return solution
    return causes


def _with_consequences(
    known: Cause,
    others: Sequence[Cause],
    bags: Iterable[Bag],
    left: Container[str],
    within: Set[str],
) -> list[Cause]:
    """The known cause with what it has brought about, and the others.

    That is what deviates no more in cases that have no deviation `left`. Where data are taken for
    frames, it is not known how they filled a device's memory: a few deviations in the cases
    `within` which there are such frames are no cause beside it.
    """
    few = max(_FEW, _FEW_SHARE * len(within))
    apart = [other for other in others if len(other.cases) > few or not other.cases <= within]
    explained = _cases(apart)
    gone = [
        bag
        for bag in bags
        if (case := bag.exchanges[0].case) not in left or (case in within and case not in explained)
    ]
    return [replace(known, consequences=gone), *apart]


def _cases(causes: Iterable[Cause]) -> set[str]:
    """The ids of the cases that these causes explain."""
    return set().union(*(cause.cases for cause in causes))


def _complexity(causes: Sequence[Cause]) -> tuple[int, int]:
    """How many causes there are, and how much it takes to say their rules."""
    return len(causes), sum(_cost(cause.rule) for cause in causes)


def _certain(causes: Sequence[Cause]) -> list[Cause]:
    """The causes of a wrong state whose deviations no other one explains, the simplest first.

    A few more, which others seem to explain, may be what such a cause has brought about.
    """
    certain = []
    for cause in causes:
        few = _FEW_SHARE * len(cause.cases)
        alike = [one for one in causes if not cause.kinds.isdisjoint(one.kinds)]
        alone = all(one is cause or len(one.cases) < few for one in alike)
        wrong = any(e.relation.facet != ANSWER and e.relation.predict for e in cause.effects)
        if cause.takes_data or (alone and wrong):
            certain.append(cause)
    return sorted(certain, key=lambda cause: _cost(cause.rule))


def find_causes(
    features: Sequence[Feature],
    exchanges: Sequence[Exchange],
    bags: Iterable[Bag],
    failed: Container[str],
) -> list[Cause]:
    """Find the causes of the deviations in the failed cases."""
    clean = [e for e in exchanges if e.right and all(d.right_code for d in e.deviations.values())]
    wrong = [bag for bag in bags if bag.exchanges[0].case in failed]
    table = Table(features, [*clean, *(e for bag in wrong for e in bag.exchanges)])
    effects = sorted(_effects(wrong, clean), key=lambda effect: -len(effect.bags))[:_EFFECTS]
    causes: list[Cause] = []
    for effect in sorted(effects, key=lambda effect: (not effect.takes_data, -effect.evidence)):
        simplest = sorted(causes, key=lambda cause: _cost(cause.rule))
        if not any(_joined(table, cause, effect) for cause in simplest):
            causes += _causes(table, effect, _resumed(effect, clean))
    last = max((e.start for e in exchanges if e.codes), default=0)
    return _without_leftovers([*causes, *_behind(table, causes)], last)


def _behind(table: Table, causes: Iterable[Cause]) -> Iterator[Cause]:
    """Causes of what the rules of these leave of their effects, if they are as simple."""
    for cause in causes:
        for effect in cause.effects:
            _, left = _parted(cause.rule, effect)
            others = _causes(table, replace(effect, bags=left), ()) if left else []
            most = max(_SIMPLE, _cost(cause.rule))
            yield from (other for other in others if _cost(other.rule) <= most)


def _without_leftovers(causes: Sequence[Cause], last: int) -> list[Cause]:
    """The causes, without those of a few deviations that another one has brought about.

    That is so where a frame before them in the same case is one at which the other cause shows.
    Beside others a long condition for a few cases is none either: it fits them by chance. But what
    came after the `last` frame that was answered has ended the run.
    """
    kept: list[Cause] = []
    for cause in sorted(causes, key=lambda cause: -len(cause.cases)):
        few = max(_FEW, _FEW_SHARE * len(kept[0].cases)) if kept else 0
        bags = [bag for effect in cause.effects for bag in effect.bags]
        back = _BACK if len(cause.cases) <= few else 0
        brought_about = [(bag, other) for bag in bags if (other := _brought_about(bag, kept, back))]
        if len(brought_about) < len(bags):
            ended = any(bag.exchanges[0].start > last for bag in bags)
            if not kept or ended or _cost(cause.rule) < _THIN * len(cause.cases):
                kept.append(cause)
            continue
        for bag, other in brought_about:
            other.consequences.append(bag)
    return kept


def _brought_about(bag: Bag, causes: Sequence[Cause], back: int) -> Cause | None:
    """The cause that shows at a frame up to this deviation, None where there is none.

    It shows in the same way, and as it foresees, at one of the frames that may have caused it, at
    one that was sent ahead of these, or at one of the `back` frames before.
    """
    for cause in causes:
        facets = {effect.relation.facet for effect in cause.effects}
        if bag.deviation.facet in facets and any(cause.foresees(e) for e in bag.exchanges):
            return cause
    case = bag.exchanges[-1].case
    exchange: Exchange | None = bag.exchanges[-1]
    in_burst = True
    while exchange is not None and exchange.case == case and (in_burst or back > 0):
        for cause in causes:
            if cause.disturbs and cause.foresees(exchange):
                return cause
        in_burst = in_burst and exchange.ahead > 0
        back -= 1
        exchange = exchange.previous
        if exchange is not None and not in_burst and exchange.settles(bag.deviation.facet):
            break  # nothing of what came before it is left
    return None


def _effects(bags: Iterable[Bag], clean: Sequence[Exchange]) -> list[Effect]:
    kinds: dict[tuple[str, str, bool], list[Bag]] = {}
    for bag in bags:
        kinds.setdefault((*bag.deviation[:2], bag.keeps_moving), []).append(bag)
    return [
        Effect(relation, own, _against(relation, own, clean))
        for kind in kinds.values()
        for relation, own in relations(kind)
    ]


def _against(relation: Relation, bags: Sequence[Bag], clean: Sequence[Exchange]) -> list[Exchange]:
    watched = unbroken = 0
    if relation.how == "changed":
        watched = min(e.watched for bag in bags for e in bag.exchanges)
    if relation.how == "extra":
        apart = sorted(e.codes[-1][0] - e.codes[0][0] for bag in bags for e in bag.exchanges)
        unbroken = apart[len(apart) * 3 // 4]  # less where one of them is that to another frame
    return [e for e in clean if e.unbroken >= unbroken and relation.shows(e, watched)]


def _joined(table: Table, cause: Cause, effect: Effect) -> bool:
    """Add an effect to a cause if one rule explains both; return whether it does."""
    if _explains(cause.rule, effect.at_setters()):
        cause.effects.append(effect)
        return True
    beside = _beside(cause, effect)
    if beside and _explains(cause.rule, beside):
        cause.effects.append(beside)
        return True
    both = [*cause.effects, effect]
    if _apart(cause, effect):
        return False
    rule = _one_rule(table, both)
    if rule is None or _cost(rule) > _cost(cause.rule) + 1:
        return False
    taken, left = _parted(rule, effect)
    if len(left) > _FEW_LEFT * len(taken):
        return False
    cause.rule, cause.effects = rule, both
    return True


def _beside(cause: Cause, effect: Effect) -> Effect | None:
    """The effect as one that shows only where the cause does, None if it does so at others."""
    shown = {id(e) for one in cause.effects for group in one.groups for e in group}
    alone = sum(not any(id(e) in shown for e in group) for group in effect.groups)
    if alone > _FEW_LEFT * len(effect.bags):
        return None
    against = [e for e in effect.against if all(one.relation.differs(e) for one in cause.effects)]
    return replace(effect, against=against)


def _apart(cause: Cause, effect: Effect) -> bool:
    """Whether only one of them keeps a device moving, and no exchange may have caused both."""
    moves = any(one.keeps_moving for one in cause.effects)
    if moves == effect.keeps_moving:
        return False
    own = {id(e) for group in effect.groups for e in group}
    return not any(id(e) in own for one in cause.effects for group in one.groups for e in group)


def _cost(rule: Rule) -> int:
    """How much it takes to say a rule: what its features cost, and each of its conditions."""
    return sum(literal.cost + 1 for literal in rule)


def _explains(rule: Rule, effect: Effect) -> bool:
    _, left = _parted(rule, effect)
    return not left and not any(matches(rule, e) for e in effect.against)


def _parted(rule: Rule, effect: Effect) -> tuple[list[Bag], list[Bag]]:
    """The deviations of an effect that a rule takes in, and the others."""
    taken: list[Bag] = []
    left: list[Bag] = []
    for bag, group in zip(effect.bags, effect.groups, strict=True):
        (taken if any(matches(rule, e) for e in group) else left).append(bag)
    return taken, left


def _one_rule(table: Table, effects: Sequence[Effect]) -> Rule | None:
    groups = [group for effect in effects for group in effect.groups]
    against = list({id(e): e for effect in effects for e in effect.against}.values())
    learner = cache(lambda most: Learner(table, most, groups, against))
    # Where data are frames, answers to them may look like more of a frame behind.
    shares = (0.9,) if any(effect.takes_data for effect in effects) else (1.0, 0.97)
    for tiers in (TIERS[:-1], TIERS[-1:]):
        for share in shares:
            for most in tiers:
                rule = learner(most).one_rule(share)
                if rule is not None and len(rule) <= _LITERALS:
                    return rule
    return None


def _resumed(effect: Effect, clean: Sequence[Exchange]) -> list[Effect]:
    """The effect as one of frames that bring back what was there before the fault before them."""
    relation = resuming(effect.relation.facet, effect.relation.how)
    if relation.facet == ANSWER or not all(map(relation.explains, effect.bags)):
        return []
    return [Effect(relation, effect.bags, _against(relation, effect.bags, clean))]


def _causes(table: Table, effect: Effect, others: Iterable[Effect]) -> list[Cause]:
    """The causes of one effect: one where one rule explains it, else as few as cover it.

    The same rule may explain it as one of `others`.
    """
    setters = effect.at_setters()
    for likely in (setters, effect, *others, setters.where_seen()):
        rule = _one_rule(table, [likely])
        if rule is not None:
            return [Cause(rule, [likely])]
    causes = []
    for rule in Learner(table, TIERS[-2], effect.groups, effect.against).rules(_RULES):
        taken, left = _parted(rule, effect)
        if taken:
            causes.append(Cause(rule, [replace(effect, bags=taken)]))
        effect = replace(effect, bags=left)
    return causes
