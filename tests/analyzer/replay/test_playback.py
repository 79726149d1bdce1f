"""Replay timing, on a clock that the test controls."""

from __future__ import annotations

import pytest

from bilprov.analyzer.replay.capture_decoding import paced
from bilprov.captures.schemas import Chunk

SECOND = 1_000_000_000
EVENTS = [Chunk(t * SECOND, "host", bytes([t])) for t in (0, 1, 1, 4)]


class Clock:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.now = 128.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds


def played(
    rate: float, *, slow: float = 0.0, start: int | None = None, end: int | None = None
) -> list[tuple[float, int]]:
    clock = Clock()
    seen = []
    for event in paced(EVENTS, rate, clock=clock, sleep=clock.sleep, start=start, end=end):
        seen.append((clock.now - 128, event.data[0]))
        clock.now += slow
    return seen


@pytest.mark.parametrize(
    ("rate", "times"),
    [(1, [0, 1, 1, 4]), (2, [0, 0.5, 0.5, 2]), (0.5, [0, 2, 2, 8]), (0, [0, 0, 0, 0])],
)
def test_each_event_comes_at_its_time_divided_by_the_rate(rate: float, times: list[float]) -> None:
    assert played(rate) == list(zip(times, [0, 1, 1, 4], strict=True))


def test_a_slow_consumer_does_not_shift_what_comes_later() -> None:
    assert played(1, slow=0.75) == [(0, 0), (1, 1), (1.75, 1), (4, 4)]


def test_only_what_is_inside_the_window_waits_and_playing_begins_at_its_start() -> None:
    assert played(1, start=SECOND, end=4 * SECOND) == [(0, 0), (0, 1), (0, 1), (0, 4)]
    assert played(1, start=3 * SECOND) == [(0, 0), (0, 1), (0, 1), (1, 4)]


def test_an_event_that_comes_late_is_played_although_its_time_is_before_the_start() -> None:
    late = [Chunk(0, "host", b"\0"), Chunk(9, "host", b"\1"), Chunk(4, "host", b"\2")]
    clock = Clock()

    seen = list(paced(late, 1, clock=clock, sleep=clock.sleep, start=5))

    assert seen == late


def test_playing_stops_soon_after_the_end_without_reading_on() -> None:
    source = iter([*EVENTS, Chunk(9 * SECOND, "host", b"\7")])
    clock = Clock()
    assert len(list(paced(source, 0, clock=clock, sleep=clock.sleep, end=1))) == 3
    assert len(list(source)) == 1
