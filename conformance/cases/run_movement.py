"""What a run of cases makes the robot do, and how fast at most: said before it begins."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain

from bilprov.conformance.cases.case import full_state
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.cases.opening import motion_first
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.spec.by_effect import Movement, frames_to, link_check, movement_of, movers
from bilprov.spec.protocol import Protocol


def run_movement(protocol: Protocol, cases: Sequence[AnyCase], *, looks: bool) -> Movement:
    """What the cases and the opening of their run make a conforming robot do.

    With `looks` the opening tries every kind of motion at the greatest speed, to see it move.
    """
    tested = chain.from_iterable(_frames(protocol, case) for case in cases)
    return movement_of(protocol, chain(_opening(protocol, looks=looks), tested))


def _opening(protocol: Protocol, *, looks: bool) -> Iterator[bytes]:
    yield from filter(None, link_check(protocol))
    first = motion_first(protocol)
    yield from first.sent if first else ()
    for spec in movers(protocol) if looks else ():
        yield from frames_to(protocol, full_state(protocol, spec))


def _frames(protocol: Protocol, case: AnyCase) -> Iterator[bytes]:
    if isinstance(case, SequenceCase):
        yield from (step.frame for step in (*case.setup, *case.steps))
        return
    yield from frames_to(protocol, case.setup)
    yield from case.sent
