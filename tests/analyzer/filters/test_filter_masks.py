"""A filter's mask over columns holds for the rows whose lines the filter lets pass."""

from __future__ import annotations

import sys
from random import Random
from typing import Any

import pytest
from bilprov.analyzer.columns.stretch import Stretch
from hypothesis import given, settings
from hypothesis import strategies as st

from bilprov.analyzer.decode.json_lines import json_line
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.filter import Filter, compile_filter
from bilprov.captures.schemas import Chunk
from bilprov.spec.codec import build, judge, nearest
from bilprov.spec.protocol import Protocol, load
from tests.support.decoding import MS, Event, devices, hosts
from tests.support.expressions import expressions
from tests.support.traffic import ACTS, SETTINGS, Act, played, told

# Slow: more than make quick has time for.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("columns_at_once")]


# 2026-09-21 13:46:40 UTC
WALL = 1_790_000_000_000_000_000


def driving(protocol: Protocol, count: int, seed: int) -> list[Event]:
    """A host that waits for each answer; some answers are wrong, unused, late, or for later."""
    random, events, t = Random(seed), [], 0
    for _ in range(count):
        header = random.randrange(256)
        frame = bytes([header]) + random.randbytes(protocol.lengths[header])
        if random.random() < 0.7:
            frame = nearest(protocol, frame)
        answer = judge(protocol, frame).response.code
        if random.random() < 0.1:
            answer = random.randrange(8)
        late = 150 * MS if random.random() < 0.05 else random.randrange(2 * MS)
        events += [Chunk(t, "host", frame), Chunk(t + late, "device", bytes([answer]))]
        t += 200 * MS
    return events


def stretches(protocol: Protocol, events: list[Event], **chosen: Any) -> list[Stretch]:
    decoder = StreamDecoder(protocol, **chosen)
    return [part for part in told(decoder, events, [500]) if isinstance(part, Stretch)]


def require_same(test: Filter, stretch: Stretch) -> None:
    records = list(stretch.records())

    host, device = test.masks(stretch)

    lines = [json_line(record) for record in hosts(records)]
    assert host.tolist() == [test(line) for line in lines if line]
    lines = [json_line(record) for record in devices(records)]
    assert device.tolist() == [test(line) for line in lines if line]


@pytest.mark.sample(1)
@pytest.mark.slow
@settings(max_examples=30)
@given(data=st.data(), acts=ACTS, chosen=SETTINGS)
def test_the_mask_of_any_filter_is_the_filter_of_each_line(
    each_protocol: Protocol, data: st.DataObject, acts: list[Act], chosen: dict[str, Any]
) -> None:
    found = stretches(each_protocol, played(each_protocol, acts), **chosen)
    for _ in range(3):
        test = compile_filter(data.draw(expressions(each_protocol)), each_protocol).started(WALL)
        for stretch in found:
            require_same(test, stretch)


@pytest.fixture(scope="module")
def driven(protocol: Protocol, horn: Protocol, wide: Protocol) -> list[tuple[Protocol, Stretch]]:
    """Much regular traffic with answers of all kinds, as columns."""
    return [
        (one, stretch)
        for one in (protocol, horn, wide)
        for heard in ({"host", "device"}, {"device"})
        for stretch in stretches(one, driving(one, 300, 2), heard=frozenset(heard))
    ]


@settings(max_examples=80)
@given(data=st.data())
def test_the_mask_over_answers_of_all_kinds_is_the_filter_of_each_line(
    driven: list[tuple[Protocol, Stretch]], data: st.DataObject
) -> None:
    protocol, stretch = data.draw(st.sampled_from(driven), label="where")

    test = compile_filter(data.draw(expressions(protocol)), protocol)

    require_same(test.started(WALL), stretch)
    require_same(test, stretch)


@pytest.mark.parametrize(
    "text",
    [
        "hex == '11 7f'",
        "hex contains 11 and data[0] >= 0x40",
        "data contains 00 00 00 or data == ''",
        "data not contains 21",
        "hex in {20, 00} or hex[1] == 9",
        "name == Speed and speed > 100 and speed <= 200.5",
        "strength in (1, 2, 3, 0x40)",
        "strength & 4 or speed & 3 == 1",
        "faulty",
        "faulty and latency > 1ms",
        "agrees == False",
        "not agrees",
        "agrees == state.moving",
        "faulty != agrees and direction == device",
        "'disagreeing' in faults or faults contains slow",
        "faults == ('slow',)",
        "reason != '' and 'ms' in reason",
        "reason contains header",
        "judgement != response",
        "judgement == OK",
        "response != OK or response > 4",
        "id == Speed or id in 5..7 or len != 1",
        "state.motion != stopped and direction == device",
        "state.moving",
        "latency > 0.001 or answers == sequence",
        "10 < t <= 20s",
        "t not in 1s..20s",
        "sequence in (answers, 4)",
        "kind == instruction",
        "state.speed == speed",
        "time > 13:50",
        "time in 23:00..13:47 or time < 2026-09-21 13:46:41.5",
    ],
)
def test_the_filters_of_every_day_have_their_mask(
    driven: list[tuple[Protocol, Stretch]], text: str
) -> None:
    for protocol, stretch in driven:
        require_same(compile_filter(text, protocol).started(WALL), stretch)


@pytest.mark.parametrize("number", [(1 << 53) + 1, (1 << 53) + 2, float(1 << 53)])
def test_numbers_that_floats_cannot_tell_apart_are_told_apart(
    grammar_text: str, number: float
) -> None:
    text = grammar_text.replace("speed=0, steering=0, led=0)", f"speed=0, led={(1 << 53) + 2})")
    protocol = load(text)
    (stretch,) = stretches(protocol, driving(protocol, 3, 1), heard=frozenset({"host"}))

    for sign in ("==", "<", ">="):
        require_same(compile_filter(f"state.led {sign} {number}", protocol), stretch)


def test_the_reasons_of_long_frames_are_theirs(wide: Protocol) -> None:
    frames = [build(wide, "Cruise", {"pace": 300 + n, "lamp": 5}) for n in range(3)]
    bad = frames[0][:-1] + b"\0"
    events: list[Event] = [Chunk(0, "host", b"".join([*frames, bad, frames[1], bad]))]
    (stretch,) = stretches(wide, events, heard=frozenset({"host"}))
    test = compile_filter("reason contains lamp", wide)

    require_same(test, stretch)
    assert test.masks(stretch)[0].tolist() == [False, False, False, True, False, True]


@pytest.mark.parametrize(
    "text",
    [
        "direction == host and name in (Speed, LED) and speed > 100",
        "faulty or latency > 0.05",
        "state.moving and state.speed > 10 and state.motion != forward",
        "hex contains 00 or data[0] > 3 or reason contains ms",
        "id == 0 and len == 0 and time > 12:00 and response in 0..4",
        "agrees == False or judgement == BAD_DATA or 'slow' in faults",
        "t > 1 and (sequence > 7 or answers > 7) and kind == instruction",
    ],
)
def test_a_mask_makes_no_object_for_each_frame(protocol: Protocol, text: str) -> None:
    frame = bytes([protocol.pad_byte])
    ok = bytes([judge(protocol, frame).response.code])
    rows = 30_000  # more do not wait at one time
    events: list[Event] = [Chunk(0, "host", frame * rows), Chunk(1, "device", ok * rows)]
    first, second = (stretches(protocol, events)[0] for _ in range(2))
    test = compile_filter(text, protocol).started(WALL)
    test.masks(first)  # what is made once for a protocol
    most = 0

    def look(frame: Any, event: str, argument: Any) -> None:
        nonlocal most
        most = max(most, sys.getallocatedblocks())

    before = sys.getallocatedblocks()
    sys.setprofile(look)
    try:
        host, device = test.masks(second)
    finally:
        sys.setprofile(None)

    assert len(host) == len(device) == rows
    assert most - before < rows / 10
