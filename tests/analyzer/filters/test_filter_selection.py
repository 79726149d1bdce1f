"""The rows that a filter selects are those whose JSON lines have the values it asks for."""

from __future__ import annotations

import operator
import sys
from collections.abc import Callable, Mapping
from functools import partial
from random import Random
from typing import Any, TypeAlias

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bilprov.analyzer.decode.batch import Batch, Records
from bilprov.analyzer.decode.json_lines import JsonLine, json_line
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.fields import Field, Kind, fields_of
from bilprov.analyzer.filters.filter import Filter, compile_filter
from bilprov.captures.events import Events
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.codec import build, judge, nearest
from bilprov.spec.protocol import Protocol, load
from tests.support.car import VARIABLES
from tests.support.decoding import MS, Event, decoded
from tests.support.traffic import ACTS, SETTINGS, Act, played

pytestmark = pytest.mark.slow  # more than make quick has time for

Values: TypeAlias = Mapping[str, Any]
Condition: TypeAlias = tuple[str, Callable[[Values], bool]]
"""A condition as it is written, and what it means for the values of a row."""

_SIGNS = {"==": operator.eq, "!=": operator.ne, "<": operator.lt, ">=": operator.ge}


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
        "response": data[0] if line.kind == "response" else None,
        "judgement": codes.get(line.judgement or ""),
        "faulty": bool(line.faults) or codes.get(line.judgement or "", 0) != 0,
    }


@st.composite
def conditions(draw: Callable[..., Any], protocol: Protocol) -> Condition:
    """A few comparisons, joined."""
    fields = [one for one in fields_of(protocol).values() if one.kind is not Kind.CLOCK]
    text, holds = draw(st.sampled_from(fields).flatmap(comparisons))
    for _ in range(draw(st.integers(0, 2))):
        more, also = draw(st.sampled_from(fields).flatmap(comparisons))
        text, holds = draw(st.sampled_from(_joined(text, holds, more, also)))
    return text, holds


def _joined(
    text: str, holds: Callable[[Values], bool], more: str, also: Callable[[Values], bool]
) -> list[Condition]:
    return [
        (f"({text}) and not {more}", lambda row: holds(row) and not also(row)),
        (f"{more} or {text}", lambda row: holds(row) or also(row)),
        (f"!({text}) && ({more})", lambda row: also(row) and not holds(row)),
    ]


def comparisons(field: Field) -> st.SearchStrategy[Condition]:
    """One comparison of a field with a value that it may have."""
    name = field.name

    def condition(text: str, holds: Callable[[Any], bool]) -> Condition:
        return text, lambda row: row.get(field.key) is not None and holds(row[field.key])

    def signed(value: Any, written: object) -> list[Condition]:
        return [
            condition(f"{name} {sign} {written}", partial(_turned(compare), value))
            for sign, compare in _SIGNS.items()
            if sign in field.signs
        ]

    def contains(part: Any, written: object) -> Condition:
        return condition(f"{name} contains {written}", lambda whole: part in whole)

    def numbers(ends: list[int]) -> list[Condition]:
        first, last = sorted(ends)
        found = [condition(f"{name} in {first}..{last}", lambda value: first <= value <= last)]
        if field.kind is Kind.SECONDS:
            return [*found, *signed(first / 1000, f"{first}ms")]
        bit = high.bit_length() - 1
        if low >= 0:
            found.append(condition(f"{name} & {1 << bit}", lambda value: value >> bit & 1 == 1))
        return [*found, *signed(first, first)]

    def octets(part: bytes) -> list[Condition]:
        byte, text = part[0] % 3, part.hex(" ")
        return [
            contains(part, text),
            *signed(part, text),
            *signed(b"", "''"),
            condition(f"{name}[{byte}] >= 32", lambda d: len(d) > byte and d[byte] >= 32),
        ]

    def words(word: str) -> list[Condition]:
        if field.kind is Kind.WORDS:
            return [contains(word, repr(word))]
        return signed(field.words[word], repr(word))

    if field.kind in (Kind.NUMBER, Kind.SECONDS):
        low = -1 if field.low is None else field.low
        high = 300 if field.high is None else field.high
        inside = st.integers(low + 1, max(low + 1, min(high - 1, low + 300)))
        found = st.lists(inside, min_size=2, max_size=2).map(numbers)
    elif field.kind is Kind.BYTES:
        found = st.sampled_from([b"\0", b"\x11", b"\x81\x09", b"\0\0\0"]).map(octets)
    elif field.kind is Kind.TEXT:
        texts = st.sampled_from(["LED", "ms", "header", "byte"])
        found = texts.map(lambda part: [contains(part, part)])
    else:
        found = st.sampled_from([*field.words]).map(words)
    return found.flatmap(st.sampled_from)


def _turned(compare: Callable[[Any, Any], bool]) -> Callable[[Any, Any], bool]:
    return lambda value, of_row: compare(of_row, value)


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
    each_protocol: Protocol, data: st.DataObject, acts: list[Act], chosen: dict[str, Any]
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


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("response != judgement", lambda row: _differ(row["response"], row["judgement"])),
        ("faulty != agrees", lambda row: _differ(row["faulty"], row["agrees"])),
        ("agrees == state.moving", lambda row: row["agrees"] is row["state.moving"]),
        ("sequence in (answers, 4)", lambda row: row["sequence"] == 4),
        ("reason in ('', byte)", lambda row: row["reason"] in ("", "byte")),
        ("faults == ('slow',)", lambda row: row["faults"] == ("slow",)),
        ("id & len > 2", lambda row: (row["id"] or 0) & (row["len"] or 0) > 2),
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
        for sign, compare in _SIGNS.items():
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
