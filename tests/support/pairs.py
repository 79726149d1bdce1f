"""Pairs of legal variants: one device that takes two other choices, which must not fail either."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import combinations

from bilprov.conformance.dut.simulator import Event, Fault, React, Reaction, Simulator
from bilprov.conformance.mutation.effects import then
from bilprov.conformance.mutation.faults import FAMILY, Variant, hooks_of, variants
from bilprov.spec.protocol import Protocol

# What loses an instruction comes first; what delays its answer, then its stop, comes last. Choices
# of words at open points come before other answers and states ("").
_ORDER = ("R-pipelining", "", "R-answer-deadline", "R-watchdog", "R-stop-latency")


@cache
def pairs(protocol: Protocol) -> dict[str, Fault]:
    """Return every pair of variants that one device can be, named after both.

    Left out are variants that need an option, two choices of one reading or at one point, and pairs
    that a simulated device cannot be, since it has each hook once.
    """
    legal = [variant for variant in variants(protocol).values() if not variant.row.allow]
    found = (_both(one, other) for one, other in combinations(legal, 2) if _fit(one, other))
    return {fault.name: fault for fault in found}


def _fit(one: Variant, other: Variant) -> bool:
    points, others = ({point for point, _ in variant.words} for variant in (one, other))
    hooks = hooks_of(one.fault).keys() & hooks_of(other.fault)
    return _reading(one) != _reading(other) and points.isdisjoint(others) and not hooks


def _both(one: Variant, other: Variant) -> Fault:
    """Return the device that is both: each reacts to what the one before has made of a frame."""
    first, second = sorted((one, other), key=_place)
    reacts = [variant.fault.react for variant in (first, second) if variant.fault.react]
    joined = behind if _reading(first) == _ORDER[0] else then
    return replace(
        Fault("", FAMILY, "", exit=0),
        name=f"{one.name} and {other.name}",
        doc=f"{one.row.doc}; {other.row.doc}",
        react=joined(*reacts) if len(reacts) > 1 else next(iter(reacts), None),
        **hooks_of(one.fault),
        **hooks_of(other.fault),
    )


def _place(variant: Variant) -> tuple[int, bool]:
    """Return where its reaction comes among those of a device."""
    reading = _reading(variant)
    return _ORDER.index(reading if reading in _ORDER else ""), not variant.words


def _reading(variant: Variant) -> str:
    return variant.name.split("=")[0]


def behind(lossy: React, reacts: React) -> React:
    """Return a hook: a frame that the first one loses is not reacted to, any other is."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        left = lossy(device, event, reaction)
        return reacts(device, event, reaction) if left is reaction else left

    return react
