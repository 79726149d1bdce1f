"""Rules: conditions on the features of an exchange, all of which hold."""

from __future__ import annotations

from typing import Literal as OneOf
from typing import NamedTuple

from bilprov.conformance.causes.exchanges import Exchange
from bilprov.conformance.causes.features import Feature, Value

Operator = OneOf["is", "from", "to", "bit", "no bit", "every"]


class Literal(NamedTuple):
    """A condition on one feature.

    `is` a value, `from` or `to` a number on, a `bit` set or not, or `every` n-th, r of it.
    """

    feature: Feature
    operator: Operator
    value: str | int | tuple[int, int]

    def holds(self, exchange: Exchange) -> bool:
        """Return whether the condition holds for an exchange."""
        return self.fits(self.feature.of(exchange))

    def fits(self, found: Value) -> bool:
        """Return whether the condition holds for this value of the feature."""
        value = self.value
        if found is None:
            return False
        if self.operator == "is":
            return found == value
        assert isinstance(found, int)
        if isinstance(value, tuple):
            return found % value[0] == value[1]
        assert isinstance(value, int)
        if self.operator == "from":
            return found >= value
        if self.operator == "to":
            return found <= value
        return bool(abs(found) >> value & 1) == (self.operator == "bit")


Rule = tuple[Literal, ...]


def matches(rule: Rule, exchange: Exchange) -> bool:
    """Return whether a rule takes in an exchange."""
    return all(literal.holds(exchange) for literal in rule)
