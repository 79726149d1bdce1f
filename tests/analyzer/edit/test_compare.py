"""`bilprov compare`: what differs between two captures, and nothing that does not."""

from __future__ import annotations

from collections.abc import Sequence
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode.records import HostRecord
from bilprov.analyzer.edit.compare import FAR, RUN, aligned
from bilprov.analyzer.replay.comparison import Exchange
from tests.support.car import car_state

# An instruction without an answer, and then so long a silence that none will come.


REST = car_state("stopped", 0, 0, 0)


def stream(keys: Sequence[int]) -> list[Exchange]:
    return [
        Exchange(HostRecord(n, n, n, "instruction", bytes([key]), None, None, REST))
        for n, key in enumerate(keys)
    ]


_edit = st.tuples(st.integers(0, 4000), st.sampled_from(["drop", "add", "change"]))


@given(
    keys=st.lists(st.integers(0, 5), max_size=3 * RUN) | st.just(list(range(250)) * 12),
    edits=st.lists(_edit, max_size=12),
)
def test_streams_are_aligned_with_no_more_edits_than_were_made(
    keys: list[int], edits: list[tuple[int, str]]
) -> None:
    changed = list(keys)
    for at, kind in edits:
        place = at % (len(changed) + 1)
        if kind != "add":
            del changed[place : place + 1]
        if kind != "drop":
            changed.insert(place, 7)
    one, other = stream(keys), stream(changed)
    pairs = list(aligned(iter(one), iter(other)))
    assert [first for first, _ in pairs if first] == one
    assert [second for _, second in pairs if second] == other
    assert all(first.key == second.key for first, second in pairs if first and second)
    made = sum(2 if kind == "change" else 1 for _, kind in edits)
    if len(keys) > 3 * RUN:  # short ones repeat themselves, where any 16 will do
        assert sum(not (first and second) for first, second in pairs) <= made


@pytest.mark.sample(2)
@pytest.mark.parametrize("missing", [RUN, 300, FAR // 2, FAR - 2 * RUN])
def test_what_follows_many_missing_frames_is_aligned_again(missing: int) -> None:
    draw = Random(missing)
    keys = [draw.randrange(256) for _ in range(2 * FAR)]
    one, other = stream(keys), stream(keys[:50] + keys[50 + missing :])
    for streams in ((one, other), (other, one)):
        pairs = list(aligned(*map(iter, streams)))
        assert sum(not (first and second) for first, second in pairs) <= missing + 2 * RUN


def test_streams_that_have_nothing_in_common_are_told_in_whole() -> None:
    one, other = stream([1] * (FAR + 5)), stream([2] * 500)
    pairs = list(aligned(iter(one), iter(other)))
    assert [first for first, _ in pairs if first] == one
    assert [second for _, second in pairs if second] == other
