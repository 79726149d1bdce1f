"""Frames in context: after each kind, with each marked value and in turn all; cuts; silences."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import pairwise, product

import pytest

from bilprov.conformance.cases.combinations import MARKED
from bilprov.conformance.cases.contexts import after_each_kind, truncations
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.cases.steps import FrameClass, Inputs, Step, frames_of, kind_of
from bilprov.spec.protocol import Protocol


def neighbours(protocol: Protocol, cases: Iterable[SequenceCase]) -> Iterator[tuple[str, Step]]:
    """Each frame with the kind of the frame right before it, counted from what is sent."""
    for case in cases:
        for before, step in pairwise(case.steps):
            yield kind_of(protocol, before), step


@cache
def contexts(protocol: Protocol) -> tuple[SequenceCase, ...]:
    """The sequences of frames after each kind, once for each protocol."""
    return tuple(after_each_kind(protocol, 1, 1))


def places(step: Step) -> Iterator[tuple[str, int]]:
    """The values of the first, the second and the last data byte of a frame."""
    data = step.frame[1:]
    yield from (("first", data[0]), ("last", data[-1])) if data else ()
    yield from (("second", data[1]),) if len(data) > 2 else ()


@pytest.mark.sample(1)
@pytest.mark.slow
def test_each_faulty_header_setting_and_motion_comes_right_after_each_kind(
    each_protocol: Protocol,
) -> None:
    kinds = set(Inputs(each_protocol, 1).kinds)
    headers, values = defaultdict(set), defaultdict(set)
    for before, step in neighbours(each_protocol, contexts(each_protocol)):
        if not step.faulty:
            values[before, kind_of(each_protocol, step)].update(step.frame[1:2])
        elif step.kind is not FrameClass.BAD_DATA:
            headers[step.frame[0]].add(before)

    known = {s.id: s.length for s in each_protocol.instructions}
    faulty = [h for h, (i, n) in enumerate(each_protocol.headers) if known.get(i) != n]
    assert sorted(headers) == faulty
    assert all(kinds <= headers[header] for header in faulty)
    for before, spec in product(kinds, each_protocol.instructions):
        assert (before, spec.name) in values
        if spec.length == 1:
            low, high = spec.fields[0].low, spec.fields[0].high
            assert {v for v in MARKED if low <= v <= high} <= values[before, spec.name]


@pytest.mark.slow
def test_marked_values_stand_at_each_place_after_each_kind_and_all_values_at_each_place(
    protocol: Protocol,
) -> None:
    marked, values, lengths = defaultdict(set), defaultdict(set), defaultdict(set)
    for before, step in neighbours(protocol, contexts(protocol)):
        if not step.faulty or step.kind is FrameClass.BAD_DATA:
            continue
        identity, length = protocol.headers[step.frame[0]]
        for place, value in places(step):
            if value in MARKED:
                marked[identity, kind_of(protocol, step), place, before].add(value)
                marked[identity, length, place].add(value)
            values[identity, kind_of(protocol, step), place].add(value)
            lengths[step.kind, length, place].add(value)

    assert all(found == set(MARKED) for found in marked.values())
    assert all(len(found) == 256 for found in values.values())
    # Of the unused IDs together, each length; of two bytes each value is first or last.
    assert min(len(lengths[FrameClass.UNUSED_ID, length, "first"]) for length in range(1, 16)) > 250


def test_frames_under_test_come_ahead_of_answers_and_after_them_and_what_leads_to_them_ahead(
    protocol: Protocol,
) -> None:
    cases = contexts(protocol)
    waited = [case for case in cases if not case.pipelined]

    assert len(cases) / 14 < len(waited) < len(cases) / 10
    for case in waited:
        observed = [len(burst.steps) for burst in case.bursts if burst.looks]
        assert set(observed) == {1}
        assert max(len(burst.steps) for burst in case.bursts) > 1


def test_cuts_hold_marked_values_and_stand_before_and_after_what_they_should(
    protocol: Protocol,
) -> None:
    cases = list(truncations(protocol, 1, 1))
    values, before, after, arrived = defaultdict(set), set(), set(), defaultdict(set)
    one_after_another = set()
    for case in cases:
        steps = list(case.steps)
        for at, step in enumerate(steps):
            if step.truncated:
                identity = protocol.headers[step.frame[0]][0]
                arrived[identity].add(len(step.frame) - 1)
                if steps[at - 1].truncated:
                    one_after_another.add((identity in protocol.by_id, len(step.frame) - 1))
                else:
                    before.add(tuple(kind_of(protocol, s) for s in steps[at - 2 : at]))
                after.add(steps[at + 1].frame)
                for place, value in places(step):
                    values[identity in protocol.by_id, len(step.frame), place].add(value)

    assert arrived == {identity: {0, 1, 2, 3, 5} for identity in protocol.ids}
    kinds = Inputs(protocol, 1).kinds
    assert before == {(first, second) for first in kinds for second in kinds}
    assert {(known, length) for known in (True, False) for length in (1, 2, 3)} <= one_after_another
    for kind in (FrameClass.VALID, FrameClass.BAD_DATA):
        steps = frames_of(protocol, kind)
        assert {step.frame for step in steps if set(step.frame[1:]) <= set(MARKED)} <= after
    for (_, size, _), found in values.items():
        assert size == 6 or set(MARKED) <= found


def test_a_seed_and_a_turn_have_data_and_states_of_their_own(protocol: Protocol) -> None:
    def first(seed: int, turns: int, number: int) -> SequenceCase:
        return list(truncations(protocol, seed, turns))[number]

    assert first(1, 1, 0) == first(1, 2, 0)
    assert first(1, 1, 0).bursts != first(2, 1, 0).bursts
    assert first(1, 2, 0).bursts != first(1, 2, len(list(truncations(protocol, 1, 1)))).bursts
