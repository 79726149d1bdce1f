"""Says a cause in words: what goes wrong, and when."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bilprov.conformance.causes.exchanges import ANSWER, MOTION
from bilprov.conformance.causes.relations import Effect
from bilprov.conformance.causes.rules import Literal, Rule
from bilprov.conformance.oracle.wording import code_words
from bilprov.spec.protocol import Protocol

_CODES = 4
"""Pairs of answers that are named; of more it is said what they have in common."""


def condition(rule: Rule) -> str:
    """Return a rule in words: `LED with rgb 8 to 255, while it moves`."""
    subjects = [literal for literal in rule if literal.feature.subject]
    names = [_literal(literal) for literal in subjects] or ["any frame"]
    others = list(_ranges([literal for literal in rule if not literal.feature.subject]))
    return ", ".join([" that is ".join(names), *others]).replace("_", " ")


def _ranges(literals: Sequence[Literal]) -> Iterator[str]:
    """The literals in words, where two ends of a range are one."""
    ends = {(literal.feature.name, literal.operator): literal for literal in literals}
    for literal in literals:
        name, operator = literal.feature.name, literal.operator
        low, high = ends.get((name, "from")), ends.get((name, "to"))
        if operator == "to" and low:
            continue
        if operator == "from" and high:
            yield literal.feature.words.format(f"{literal.value} to {high.value}")
        else:
            yield _literal(literal)


def _literal(literal: Literal) -> str:
    words, value = literal.feature.words, literal.value
    if literal.operator == "from":
        return words.format(f"{value} or more")
    if literal.operator == "to":
        return words.format(f"{value} or less")
    if literal.operator == "bit":
        return words.format(f"(bit {value} set)")
    if literal.operator == "no bit":
        return words.format(f"(bit {value} clear)")
    if isinstance(value, tuple):
        return f"at one in {value[0]} of the {literal.feature.name} since power-on"
    return words.format(value)


def deviations(protocol: Protocol, effects: Sequence[Effect]) -> str:
    """Return what goes wrong in words: `does not stop, and steering is off by -256`."""
    return " and ".join(dict.fromkeys(_effect(protocol, effect) for effect in effects))


def _effect(protocol: Protocol, effect: Effect) -> str:
    relation = effect.relation
    deviation = effect.bags[0].deviation
    late = {"changed": " after a while", "late": " late"}.get(relation.how, "")
    if relation.facet == ANSWER:
        return _answer(protocol, effect)
    if relation.facet == MOTION:
        expected = {bag.deviation.expected for bag in effect.bags}
        if relation.how == "late":
            return "stops late" if expected == {effect.bags[0].still} else "moves late"
        if effect.keeps_moving:
            return "moves again by itself" if late else "does not stop"
        seen = {str(bag.deviation.seen) for bag in effect.bags}
        stays = relation.words.startswith("stays") and len(seen) > 1
        motion = "keeps its motion" if stays else relation.words
        motion = f"is {seen.pop()}" if len(seen) == 1 else motion
        return motion.replace("_", " ") + late
    if relation.how == "late":
        return f"{deviation.facet} changes late"
    return f"{deviation.facet} {relation.words}{late}"


def _answer(protocol: Protocol, effect: Effect) -> str:
    pairs = sorted({bag.deviation[2:] for bag in effect.bags}, key=str)
    if effect.relation.how != "other" or len(pairs) > _CODES:
        return effect.relation.words
    words = (f"{_code(protocol, seen)} instead of {_code(protocol, due)}" for due, seen in pairs)
    return f"answers {', '.join(words)}"


def _code(protocol: Protocol, code: int | str | None) -> str:
    return code_words(protocol, code) if isinstance(code, int) else "nothing"
