"""A timeline has what the records have: exactly where there is room, else its bounds in steps."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from functools import reduce
from itertools import repeat
from operator import or_
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode.records import HostRecord, Record, is_frame, serious_faults
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.totals import timeline
from bilprov.analyzer.totals.timeline import Timeline, numbers_of
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.spec.codec import build
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State
from tests.support.decoding import devices, hosts
from tests.support.traffic import ACTS, BATCHES, SETTINGS, Acts, played, records_of, told

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("columns_at_once")]


class Held(NamedTuple):
    """A state from a time on: motion as `States` has it, speed, steering, the LED if a number."""

    t: int
    motion: int
    speed: int
    steering: int
    led: int


def held(t: int, state: State, names: Sequence[str]) -> Held:
    motion = 2 * list(Motion).index(state.motion) + state.moving
    return Held(t, motion, state.speed, state.steering, state.led if "led" in names else 0)


def changes(protocol: Protocol, records: Sequence[Record], begin: int) -> list[Held]:
    """The states of the records one by one, those alone that differ from the one before."""
    names = numbers_of(protocol)
    every = [held(begin, protocol.power_on, names)]
    every += [held(record.known, record.state, names) for record in hosts(records)]
    kept = [one for at, one in enumerate(every) if not at or every[at - 1]._replace(t=one.t) != one]
    return sorted(kept, key=lambda one: one.t)


def require_states(found: Timeline, expected: list[Held], most: int) -> None:
    states, step = found.states()
    assert len(states["t"]) <= most
    assert bool(step) is (len(expected) > most)
    if not step:
        rows = zip(
            states["t"],
            states["motion"],
            states["speed"]["last"],
            states["steering"]["last"],
            states["led"]["last"] if "led" in states else repeat(0, len(states["t"])),
            strict=True,
        )
        assert [Held(*row) for row in rows] == expected
        return
    times = [one.t for one in expected]
    for row, t in enumerate(states["t"]):
        after = (
            bisect_left(times, states["t"][row + 1]) if row + 1 < len(states["t"]) else len(times)
        )
        at = bisect_left(times, t)  # what begins with the row; if nothing does, what holds then
        inside = expected[at if times[at : at + 1] == [t] else bisect_right(times, t) - 1 : after]
        for values, place in ((states["speed"], 2), (states["steering"], 3)):
            assert values["low"][row] == min(one[place] for one in inside)
            assert values["high"][row] == max(one[place] for one in inside)
            assert values["last"][row] == inside[-1][place]
        assert states["motion"][row] == inside[-1].motion
        assert states["seen"][row] == reduce(or_, (1 << one.motion for one in inside))


def require_marks(found: Timeline, records: Sequence[Record], most: int) -> None:
    marks, step = found.marks()
    odd = [faults for record in records if (faults := serious_faults(record))]
    odd.sort(key=lambda faults: faults[0].t)
    assert sum(mark.amount for mark in marks) == sum(map(len, odd))
    assert len(marks) <= most
    assert bool(step) is (len(odd) > most)
    words = {
        (f[0].t, ", ".join(one.kind for one in f), "; ".join(one.reason for one in f)) for f in odd
    }
    assert {(mark.t, mark.kind, mark.reason) for mark in marks} <= words
    firsts: dict[int, int] = {}
    for place, faults in enumerate(odd):
        t = faults[0].t
        firsts.setdefault(max(0, t - found.begin) // step if step else place, t)
    assert [mark.t for mark in marks] == list(firsts.values())


def require_latencies(found: Timeline, records: Sequence[Record], most: int) -> None:
    latencies, step = found.latencies()
    answers = [(r.t, r.latency) for r in devices(records) if r.latency is not None]
    assert sum(latencies["count"]) == len(answers)
    assert len(latencies["t"]) <= most
    assert bool(step) is (len(answers) > most)
    if not step:
        rows = zip(latencies["t"], latencies["low"], latencies["high"], strict=True)
        assert sorted(rows) == sorted((t, latency, latency) for t, latency in answers)
        return
    for t, low, high in zip(latencies["t"], latencies["low"], latencies["high"], strict=True):
        mine = [latency for at, latency in answers if t <= at < t + step]
        assert (low, high) == (min(mine), max(mine))


def test_a_frame_that_began_before_all_that_came_earlier_is_the_begin(protocol: Protocol) -> None:
    decoder, found = StreamDecoder(protocol), Timeline(protocol)
    speed = build(protocol, "Speed", {"speed": 80})
    for events in (
        [Chunk(0, "host", speed[:1]), Line(5 * MS, "break", "host")],
        [Chunk(9 * MS, "host", speed[1:])],
    ):
        for batch in decoder.feed(events):
            found.add(batch)
    states, _ = found.states()
    assert (found.begin, found.end) == (0, 9 * MS)
    assert (states["t"], states["speed"]["last"]) == ([0, 9 * MS], [0, 80])


@pytest.mark.sample(1)
@given(acts=ACTS, batches=BATCHES, chosen=SETTINGS, most=st.sampled_from([1 << 14, 30, 8]))
def test_a_timeline_has_what_the_records_have(
    each_protocol: Protocol,
    acts: Acts,
    batches: list[int],
    chosen: dict[str, Any],
    most: int,
) -> None:
    parts = told(StreamDecoder(each_protocol, **chosen), played(each_protocol, acts), batches)
    records = records_of(parts)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(timeline, "MOST", most)
        patch.setattr(timeline, "MOST_MARKS", most)
        found = Timeline(each_protocol)
        for part in parts:
            found.add(part)
        shown = [record for record in records if is_frame(record) or serious_faults(record)]
        if not shown:
            assert found.states()[0]["t"] == []
            return
        assert found.begin == min(record.t for record in shown)
        assert found.end == max(r.end if isinstance(r, HostRecord) else r.t for r in shown)
        require_states(found, changes(each_protocol, records, found.begin), most)
        require_marks(found, records, most)
        require_latencies(found, records, most)
