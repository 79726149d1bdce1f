"""The rows that a filter selects are those whose JSON lines have the values it asks for."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bilprov.analyzer.decode.batch import Batch, Records
from bilprov.analyzer.decode.json_lines import JsonLine, json_line
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.filter import Filter, compile_filter
from bilprov.analyzer.output.row_columns import nanoseconds
from bilprov.captures.events import Events
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.codec import build, judge, nearest
from bilprov.spec.protocol import Protocol, load
from tests.support.car import VARIABLES
from tests.support.decoding import MS, Event, decoded
from tests.support.expressions import SIGNS, Values, conditions
from tests.support.traffic import ACTS, SETTINGS, Acts, played

pytestmark = pytest.mark.slow  # more than make quick has time for


def values(protocol: Protocol, line: JsonLine) -> Values:
    """What a row has by name, read out of its JSON line; None where it lacks it."""
    codes = {spec.name: spec.code for spec in protocol.responses}
    data, instruction = bytes.fromhex(line.hex), line.kind in ("instruction", "truncated")
    identity, length = protocol.headers[data[0]] if instruction else (None, None)
    state = {f"state.{name}": getattr(line.state, name) for name in (*VARIABLES, "moving")}
    return {
        **{name: getattr(line, name) for name in JsonLine.__struct_fields__},
        **{f"fields.{name}": value for name, value in line.fields.items()},
        **state,
        "id": identity,
        "len": length,
        "data": data[1:] if instruction else None,
        "hex": data,
        "t_ns": nanoseconds(line.t),
        "latency_ns": None if line.latency is None else nanoseconds(line.latency),
        "response": data[0] if line.kind == "response" else None,
        "judgement": codes.get(line.judgement or ""),
        "faulty": bool(line.faults) or codes.get(line.judgement or "", 0) != 0,
    }


def batches(protocol: Protocol, events: list[Event], **chosen: Any) -> list[Batch]:
    """The rows as they are decoded one by one, and as arrays."""
    decoder = StreamDecoder(protocol, **chosen)
    one_by_one = Records(decoded(Session(protocol, **chosen), events))
    return [one_by_one, *decoder.decode(Events.of(events)), *decoder.finish()]


def require_selected(test: Filter, batch: Batch, holds: Callable[[Values], bool]) -> None:
    lines = [json_line(record) for record in batch.records()]

    passing = batch.in_order(test.selection(batch)).tolist()

    assert passing == [line is not None and holds(values(test.protocol, line)) for line in lines]


@pytest.mark.sample(1)
@settings(max_examples=30)
@given(data=st.data(), acts=ACTS, chosen=SETTINGS)
def test_a_filter_selects_the_rows_of_any_traffic_whose_lines_it_describes(
    each_protocol: Protocol, data: st.DataObject, acts: Acts, chosen: dict[str, Any]
) -> None:
    found = batches(each_protocol, played(each_protocol, acts), **chosen)
    for _ in range(3):
        text, holds = data.draw(conditions(each_protocol))
        for batch in found:
            require_selected(compile_filter(text, each_protocol), batch, holds)


def driving(protocol: Protocol, count: int, seed: int) -> list[Event]:
    """A host that waits for each answer; some are wrong, unused or late, some frames cut short."""
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
        cut = frame[:1] if random.random() < 0.02 else frame
        events += [Chunk(t, "host", cut), Chunk(t + late, "device", bytes([answer]))]
        t += 200 * MS
    return [*events, Line(t, "break", "host"), Line(t + 1, "opened", "")]


@pytest.fixture(scope="module")
def driven(protocol: Protocol, horn: Protocol, wide: Protocol) -> list[tuple[Protocol, Batch]]:
    """Much traffic with answers of all kinds."""
    return [
        (one, batch)
        for one in (protocol, horn, wide)
        for heard in ({"host", "device"}, {"device"})
        for batch in batches(one, driving(one, 200, 2), heard=frozenset(heard))
    ]


@settings(max_examples=80)
@given(data=st.data())
def test_a_filter_selects_the_answers_of_all_kinds_whose_lines_it_describes(
    driven: list[tuple[Protocol, Batch]], data: st.DataObject
) -> None:
    protocol, batch = data.draw(st.sampled_from(driven), label="where")

    text, holds = data.draw(conditions(protocol))

    require_selected(compile_filter(text, protocol), batch, holds)


def _differ(one: Any, other: Any) -> bool:
    return one is not None and other is not None and one != other


@pytest.mark.sample(3)
@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("response != judgement", lambda row: _differ(row["response"], row["judgement"])),
        ("faulty != agrees", lambda row: _differ(row["faulty"], row["agrees"])),
        ("agrees == state.moving", lambda row: row["agrees"] is row["state.moving"]),
        ("reason in ('', byte)", lambda row: row["reason"] in ("", "byte")),
        ("faults == ('slow',)", lambda row: row["faults"] == ("slow",)),
    ],
)
def test_two_names_are_compared_row_by_row(
    driven: list[tuple[Protocol, Batch]], text: str, holds: Callable[[Values], bool]
) -> None:
    for protocol, batch in driven:
        require_selected(compile_filter(text, protocol), batch, holds)


@pytest.mark.parametrize("number", [(1 << 53) + 1, (1 << 53) + 2, float(1 << 53)])
def test_numbers_that_floats_cannot_tell_apart_are_told_apart(
    grammar_text: str, number: float
) -> None:
    wide = grammar_text.replace('led=Bits("RGB")', f"led=Whole(0, {1 << 60})")
    text = wide.replace("speed=0, steering=0, led=0)", f"speed=0, led={(1 << 53) + 2})")
    protocol = load(text)
    for batch in batches(protocol, driving(protocol, 3, 1), heard=frozenset({"host"})):
        for sign, compare in SIGNS.items():
            meaning = partial(_led, compare, int(number))
            require_selected(compile_filter(f"state.led {sign} {number}", protocol), batch, meaning)


def _led(compare: Callable[[Any, Any], bool], number: int, row: Values) -> bool:
    return compare(row["state.led"], number)


def test_numbers_beyond_64_bits_are_asked_for(grammar_text: str) -> None:
    wide = grammar_text.replace('led=Bits("RGB")', f"led=Whole(0, {1 << 70})")
    protocol = load(wide.replace("speed=0, steering=0, led=0)", f"speed=0, led={1 << 70})"))
    (batch, *_) = batches(protocol, driving(protocol, 3, 1))

    for text, holds in (
        (f"state.led > {1 << 66}", lambda row: row["state.led"] > 1 << 66),
        (f"state.led in 1..{1 << 70}", lambda row: 1 <= row["state.led"] <= 1 << 70),
        ("state.led & 5", lambda row: row["state.led"] & 5 > 0),
    ):
        require_selected(compile_filter(text, protocol), batch, holds)


def test_the_reasons_of_long_frames_are_theirs(wide: Protocol) -> None:
    frames = [build(wide, "Cruise", {"pace": 300 + n, "lamp": 5}) for n in range(3)]
    bad = frames[0][:-1] + b"\0"
    events: list[Event] = [Chunk(0, "host", b"".join([*frames, bad, frames[1], bad]))]
    for batch in batches(wide, events, heard=frozenset({"host"})):
        test = compile_filter("reason contains lamp", wide)

        require_selected(test, batch, lambda row: "lamp" in row["reason"])


@pytest.mark.sample(3)
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
def test_no_object_is_made_for_each_regular_row(protocol: Protocol, text: str) -> None:
    frame = bytes([protocol.pad_byte])
    ok = bytes([judge(protocol, frame).response.code])
    rows = 30_000  # more do not wait at one time
    events = Events.of([Chunk(0, "host", frame * rows), Chunk(1, "device", ok * rows)])
    first, second = (StreamDecoder(protocol).decode(events)[0] for _ in range(2))
    test = compile_filter(text, protocol).started(1_790_000_000_000_000_000)
    test.selection(first)  # what is made once for a protocol
    most = 0

    def look(frame: Any, event: str, argument: Any) -> None:
        nonlocal most
        most = max(most, sys.getallocatedblocks())

    before = sys.getallocatedblocks()
    sys.setprofile(look)
    try:
        host, device, _ = test.selection(second)
    finally:
        sys.setprofile(None)

    assert len(host) == len(device) == rows
    assert most - before < rows / 10
