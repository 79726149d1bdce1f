"""Mixtures: faulty devices that follow one reading for some frames and another for the others.

Only mixtures that can show both choices are made: one by ID, for example, needs two IDs at which
the point of the reading arises.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import product

from bilprov.conformance.dut.fault import Event, Fault
from bilprov.conformance.mutation.variants import MIXTURE, Variant, variants
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol

_TIMES = 12  # how often the point arises before the device changes its choice


@cache
def mixtures(protocol: Protocol) -> dict[str, Fault]:
    """Return every mixture by name."""
    found = [
        fault
        for variant in variants(protocol).values()
        if variant.mixes
        for fault in mixtures_of(protocol, variant)
    ]
    return {fault.name: fault for fault in found}


def mixtures_of(protocol: Protocol, variant: Variant) -> Iterator[Fault]:
    """Yield the mixtures of one variant: by frame, by count, by ID and by motion, if both show."""
    if not variant.mixes:
        return
    ids, motions = _where_it_arises(protocol, variant)
    rows = [
        ("by-frame", "every second time", "times !& 1"),
        (
            f"after-{_TIMES}",
            f"after it has chosen otherwise {_TIMES} times",
            f"times >= {_TIMES}",
        ),
    ]
    if len(ids) > 1:
        some, others = (", ".join(map(str, part)) for part in (ids[::2], ids[1::2]))
        words = f"for ID {some} and not for {others}"
        rows.append(("by-id", words, f"id {some.replace(',', '')}"))
    if len(motions) > 1:
        moves = motions[1::2]
        words = f"while its motion is {' or '.join(moves)}"
        rows.append(("by-motion", words, f"motion {' '.join(moves)}"))
    for name, words, when in rows:
        fault = variant.taking(
            when, f"{MIXTURE}{variant.name}:{name}", f"{variant.doc}, but only {words}"
        )
        yield replace(
            fault,
            family="mixture",
            exit=1,
            caught_by=("reading/*",),
            clauses=("header", "instructions", "responses", "safety"),
        )


def _where_it_arises(protocol: Protocol, variant: Variant) -> tuple[list[int], list[str]]:
    """Return the IDs and the motions at which the device can take the choice."""
    acting = variant.fault.trigger
    assert acting is not None
    top = {name: high for name, (_, high) in protocol.limits.items()}
    ids: set[int] = set()
    motions: dict[str, None] = {}
    by = protocol.car.by
    for motion, frame in product(protocol.variables[by].words, _frames(protocol)):
        judgement = judge(protocol, frame)
        before = protocol.state(**{by: motion}, **top)
        kind = "truncated" if judgement.truncated else "instruction"
        if acting.holds(Event(protocol, judgement, before, 0, 0, kind, 0), {}):
            ids.add(judgement.id)
            motions[motion] = None
    return sorted(ids), list(motions)


def _frames(protocol: Protocol) -> Iterator[bytes]:
    """Yield, for each header, low and high data, and the header alone."""
    for header, length in enumerate(protocol.lengths):
        for fill in (protocol.pad_byte, 0xFF):
            yield bytes([header]) + bytes([fill]) * length
        yield bytes([header])
