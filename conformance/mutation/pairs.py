"""Pairs of legal variants: one device that takes two other choices, which must not fail either."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import Any

from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.mutation.faults.vocabulary import then
from bilprov.conformance.mutation.variants import FAMILY, Variant, variants
from bilprov.spec.protocol import Protocol

# A device has each of these hooks and settings once.
_ONCE = ("hear", "begins", "power_on", "banner", "whole_frame")
# What the simulated variants cannot be at once: one ends a wait that the other counts (both have an
# idle time of their own, or delay the same stop or answer), or loses what the other remembers.
_EXCLUSIVE = {
    frozenset(pair)
    for pair in (
        ("R-answer-point", "R-truncation-timeout"),
        ("R-answer-point", "R-stop-latency"),
        ("R-stop-point", "R-stop-latency"),
        ("R-answer-deadline", "R-stop-latency"),
        ("R-answer-deadline", "R-watchdog"),
        ("R-drain-known", "R-truncation-timeout"),
        ("R-drain-unused", "R-truncation-timeout"),
        ("R-pipelining", "R-truncation-timeout"),
        ("R-pipelining", "R-drain-known"),
        ("R-pipelining", "R-drain-unused"),
        ("R-pipelining", "R-speed-moving"),
    )
}
_USUAL = Fault("", FAMILY, "", exit=0)


@cache
def pairs(protocol: Protocol) -> dict[str, Fault]:
    """Return every pair of variants that one device can be, named after both.

    Left out are variants that need an option, two choices at one point, and pairs that a simulated
    device cannot be, since it has each hook once.
    """
    legal = [variant for variant in variants(protocol).values() if not variant.allow]
    found = (_both(one, other) for one, other in combinations(legal, 2) if _fit(one, other))
    return {fault.name: fault for fault in found}


def _fit(one: Variant, other: Variant) -> bool:
    points, others = ({point for point, _ in variant.words} for variant in (one, other))
    hooks = _hooks(one.fault).keys() & _hooks(other.fault)
    readings = frozenset((one.reading, other.reading))
    exclusive = len(readings) == 1 or readings in _EXCLUSIVE
    return not exclusive and points.isdisjoint(others) and not hooks


def _hooks(fault: Fault) -> dict[str, Any]:
    """Return the hooks and settings besides the reaction that differ from the reference."""
    names = (*_ONCE, "timeout")
    return {n: getattr(fault, n) for n in names if getattr(fault, n) != getattr(_USUAL, n)}


def _both(one: Variant, other: Variant) -> Fault:
    """Return the device that is both.

    Answers and states are chosen first, then what delays or loses them.
    """
    in_order = sorted((other, one), key=lambda variant: not variant.words)
    reacts = [variant.fault.react for variant in in_order if variant.fault.react]
    return replace(
        _USUAL,
        name=f"{one.name} and {other.name}",
        doc=f"{one.doc}; {other.doc}",
        react=then(*reacts) if reacts else None,
        **_hooks(one.fault),
        **_hooks(other.fault),
    )
