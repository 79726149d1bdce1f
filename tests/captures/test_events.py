"""Events as arrays are the events that they were made of, whole and in parts."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from bilprov.captures.events import Events
from bilprov.captures.schemas import Chunk, Line

_TIMES = st.integers(-(1 << 62), 1 << 62)
_CHUNKS = st.builds(Chunk, _TIMES, st.sampled_from(["host", "device"]), st.binary(max_size=5))
_LINES = st.builds(Line, _TIMES, st.sampled_from(["gap", "open"]))
_SEQUENCES = st.lists(_CHUNKS | _LINES, max_size=12)


@given(events=_SEQUENCES, data=st.data())
def test_any_part_of_the_arrays_gives_the_single_events_that_it_was_made_of(
    events: list[Chunk | Line], data: st.DataObject
) -> None:
    arrays = Events.of(events)
    start = data.draw(st.integers(0, len(events)))
    stop = data.draw(st.integers(start, len(events)))
    assert list(arrays.single()) == events
    assert list(arrays.part(start, stop).single()) == events[start:stop]
