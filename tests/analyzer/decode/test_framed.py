"""Frames of any layout in columns are the rows that one Session gives, however they are fed."""

from __future__ import annotations

from functools import cache
from random import Random
from typing import Literal

import pytest
from msgspec.structs import replace

from bilprov.analyzer.decode.batch import Records
from bilprov.analyzer.decode.columns import ColumnBatch
from bilprov.analyzer.decode.json_lines import json_line
from bilprov.analyzer.decode.records import FaultRecord
from bilprov.analyzer.decode.session import SKEW, Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import Chunk, Direction
from bilprov.spec.codec import build
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol, load
from tests.analyzer.decode.test_foreign_traffic import TRAFFIC, events
from tests.analyzer.decode.test_foreign_traffic import events as recorded
from tests.analyzer.decode.test_stream import same
from tests.support import ROOT
from tests.support.decoding import MS, Event, conversation, decoded, devices, hosts
from tests.support.drawn_layouts import drawn_layout
from tests.support.framed_traffic import READS_UNCHECKED, WITH_SYNC, Traffic, exchanges
from tests.support.grammars import SWITCHES, checked_digits
from tests.vectors_checks import CHECKS, CheckVector

pytestmark = pytest.mark.usefixtures("columns_at_once")
EXAMPLES = ("relay_board", "roboclaw")
SHIPPED = ("modbus-rtu", "stk500v1", "dynamixel1", *EXAMPLES)
# Those whose answers tell their sizes, and whose states follow from the requests alone.
IN_ARRAYS = ("modbus-rtu", "dynamixel1", "roboclaw")
BOTH = frozenset({"host", "device"})


@cache
def protocol_of(name: str | int) -> Protocol:
    if isinstance(name, int):
        return drawn_layout(name).protocol
    return load_protocol(str(ROOT / "examples" / f"{name}.py") if name in EXAMPLES else name)


@pytest.mark.sample(8)
@pytest.mark.parametrize("name", [*IN_ARRAYS, *range(40)])
def test_regular_traffic_is_columns_alone(name: str | int) -> None:
    count = 500 if name in SHIPPED else 60
    events = exchanges(protocol_of(name), Random(1), count, Traffic(odd=0, pipelined=3))

    parts = same(protocol_of(name), events, [70])

    assert {type(batch) for batch in parts} == {ColumnBatch}
    assert sum(batch.counts.frames for batch in parts) >= count


EARLY = [0, 1000, MS, 5 * MS, 19 * MS, 25 * MS]


def stamped(random: Random, events: list[Event]) -> list[Event]:
    """The events, with answers that a tap stamps before their requests."""
    times = [
        max(0, event.t - random.choice(EARLY) * (getattr(event, "direction", "") == "device"))
        for event in events
    ]
    moved = [replace(event, t=t) for event, t in zip(events, times, strict=True)]
    return sorted(moved, key=lambda event: event.t)


@pytest.mark.sample(2)
@pytest.mark.parametrize("seed", range(70))
@pytest.mark.parametrize("name", [*SHIPPED, None])
def test_odd_traffic_is_that_of_a_session(name: str | None, seed: int) -> None:
    random = Random(f"{name} {seed}")
    protocol = protocol_of(name or seed)
    how = Traffic(random.choice([0.02, 0.1, 0.3]), random.choice([1, 3, 300]), random.randint(1, 3))
    events = exchanges(protocol, random, 60, how)
    if seed >= 60:
        events = stamped(random, events)
    looks = frozenset(random.sample(range(len(events)), 4))
    batches = [random.choice([1, 2, 3, 10, 1000]) for _ in range(4)]
    sides = random.choice([BOTH] * 4 + [frozenset({"host"}), frozenset({"device"})])

    same(
        protocol,
        events,
        batches,
        looks,
        skew=random.choice([0, SKEW]),
        attached=random.random() < 0.3,
        timeout=random.choice([None] * 5 + [0, 1, 5 * MS, 1500 * MS]),
        heard=sides,
    )


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("name", [one for one in TRAFFIC if TRAFFIC[one][0] in IN_ARRAYS])
def test_recorded_traffic_is_columns_alone(name: str, single: bool) -> None:
    protocol = protocol_of(TRAFFIC[name][0])

    parts = same(protocol, list(recorded(name, single=single)), [50])

    assert not any(isinstance(batch, Records) for batch in parts)


@pytest.mark.parametrize("order", ["big", "little"])
@pytest.mark.parametrize("vector", CHECKS, ids=str)
def test_a_published_check_is_right_and_no_other(
    vector: CheckVector, order: Literal["big", "little"]
) -> None:
    protocol, right = checked_digits(vector, order)
    wrong = right[:5] + b"!" + right[6:]
    sent = [Chunk(at * 200 * MS, "host", frame) for at, frame in enumerate([right, wrong] * 20)]

    parts = same(protocol, sent, [40])

    assert any(isinstance(batch, ColumnBatch) for batch in parts)
    rows = [row for batch in parts for row in hosts(batch.records())]
    judged = [row.judgement.outcome for row in rows if row.judgement]
    assert judged == [Outcome.VALID, Outcome.BAD_CHECKSUM] * 20


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (
            "01 0000 0700 01 05 ee",
            "modes is 0 (off) 7, allowed are 0 (off), 1 (on), 300 (slow)",
        ),
        ("01 0000 0100 02 05 fc ee", "limits is 5 -4, allowed are -3 to 5"),
    ],
)
def test_each_of_several_numbers_has_its_names_and_its_range(wrong: str, reason: str) -> None:
    protocol = load(SWITCHES)
    right = build(protocol, "Set", {"modes": ["on", 300], "limits": [-3, 5]})
    assert right == bytes.fromhex("01 0100 2c01 02 fd 05 ee")
    told = "answer alarms=3 (hot slow) 0 (none)"

    sides: list[tuple[Direction, bytes]] = [
        ("host", right),
        ("device", bytes.fromhex("01 03 00 ee")),
        ("host", bytes.fromhex(wrong)),
    ]
    sent = [Chunk(at * 100 * MS, *sides[at % 3]) for at in range(60)]
    parts = same(protocol, sent, [40])

    assert any(isinstance(batch, ColumnBatch) for batch in parts)
    rows = [row for batch in parts for row in batch.records()]
    assert {row.judgement.reason for row in hosts(rows) if row.judgement} == {"", f"Set.{reason}"}
    assert {row.reply.describe() for row in devices(rows) if row.reply} == {told}
    with pytest.raises(ValueError, match=r"Set\.limits is 6, allowed are -3 to 5"):
        build(protocol, "Set", {"modes": [0, 0], "limits": [6]})


def test_requests_without_a_check_are_columns_too() -> None:
    """The answer to such a request counts it, but not the fixed byte in front of it."""
    protocol = load(WITH_SYNC)
    sides: list[tuple[Direction, str]] = [
        ("host", "55 80 18 01"),
        ("device", "00 7c 34 9f"),
        ("host", "55 80 00 09 aa 73"),
        ("device", "ff"),
    ]
    sent = [
        Chunk(at * 100 * MS, side, bytes.fromhex(text))
        for at, (side, text) in enumerate(sides * 20)
    ]

    parts = same(protocol, sent, [40])

    assert not any(isinstance(batch, Records) for batch in parts)
    rows = [row for batch in parts for row in batch.records()]
    assert {row.judgement.outcome for row in hosts(rows) if row.judgement} == {Outcome.VALID}
    told = {row.reply.describe() for row in devices(rows) if row.reply}
    assert told == {"answer voltage=124", "ACK"}
    for text in ("len == 1 and data == 01", "channel == 1"):
        test = compile_filter(text, protocol)
        assert sum(int(next(iter(test.selection(batch))).sum()) for batch in parts) == 20, text


def test_the_last_field_of_a_request_without_a_check_goes_to_its_end() -> None:
    text = READS_UNCHECKED.replace("Ranged(Byte, 1, 2)", "Prefixed(Byte, GreedyBytes)")
    protocol = load(text.replace("import Byte,", "import Byte, GreedyBytes, Prefixed,"))
    sent = [Chunk(at * 100 * MS, "host", bytes.fromhex("80 18 02 41 42")) for at in range(20)]

    test = compile_filter("channel == 41 42", protocol)
    found = [test.selection(batch) for batch in same(protocol, sent, [40])]

    assert sum(int(next(iter(each)).sum()) for each in found) == 20


def test_only_a_check_confirms_where_frames_begin() -> None:
    """A tap joined the line; whether a request without a check began there is not known."""
    sent = ["80 18 01", "80 00 09 aa 73", "80 18 01"]
    events = [Chunk(at * 100 * MS, "host", bytes.fromhex(text)) for at, text in enumerate(sent)]

    rows = hosts(decoded(Session(load(READS_UNCHECKED), attached=True), events))

    assert [bool(row.uncertain) for row in rows] == [True, False, False]


# --------------------------------------------------------------------------------------------------


# The answers that the document does not allow, by server.
WRONG = {
    "pymodbus": {
        "112b0e01830000000ea3",  # to a function that the grammar does not have
        "11800181c5",  # function 80, code 01, to no register at all: 83 and 03 are due
        "1105000aff00aea8",  # a coil's value 1234 is taken for "on"
    },
    "libmodbus": set(),
}


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("server", list(WRONG))
def test_every_answer_is_to_the_request_before_it(server: str, single: bool) -> None:
    protocol = load_protocol("modbus-rtu")
    chunks = list(events(f"{server}_faults", single=single))
    last, pairs = b"", []
    for chunk in events(f"{server}_faults"):
        if chunk.direction == "host":
            last = chunk.data
        else:
            pairs.append((last, chunk.data))

    records = decoded(Session(protocol), chunks)
    same(protocol, list(chunks), [1, 7, 1000])

    sent = b"".join(chunk.data for chunk in chunks if chunk.direction == "host")
    asked, answers = {one.sequence: one for one in hosts(records)}, devices(records)
    assert b"".join(one.data for one in asked.values()) == sent
    assert [one.data for one in answers] == [answer for _, answer in pairs]
    for one, (request, _) in zip(answers, pairs, strict=True):
        assert one.instruction is not None
        assert asked[one.instruction].data.endswith(request)
    assert {one.data.hex() for one in answers if one.faults} == WRONG[server]
    assert {one.faults[0].kind for one in records if isinstance(one, FaultRecord)} == {"unanswered"}


def test_recorded_faults_are_of_every_kind() -> None:
    records = decoded(Session(load_protocol("modbus-rtu")), events("libmodbus_faults"))
    asked = hosts(records)
    judged, answered = (
        {line.outcome for one in side if (line := json_line(one))}
        for side in (asked, devices(records))
    )

    assert judged == {"valid", "unknown-id", "bad-data", "bad-checksum", "truncated"}
    assert answered == {"valid", "unknown-id", "bad-data"}
    assert {one.kind for one in asked} == {"instruction", "truncated"}


# -- registers with names --------------------------------------------------------------------------

FEETECH = ROOT / "examples" / "feetech.py"
SERVO = load_protocol(str(FEETECH))
# A request, its answer, and the registers in each; those of the document of the servos.
POSITION = "FFFF 01 04 02 38 02 BE", "FFFF 01 04 00 18 05 DD"
MOVE = "FFFF 01 09 03 2A 00 08 00 00 E8 03 D5"
SEVERAL = "FFFF FE 0A 83 2A 02 01 00 02 02 03 02 3E"


def frame(text: str) -> bytes:
    return bytes.fromhex(text)


MOVED = frame(MOVE), frame("FFFF 01 02 00 FC")
# Exchanges, and which rows filters of registers choose.
FILTERS = [
    (
        [MOVED, (frame(POSITION[0]), frame(POSITION[1]))],
        {
            "goal_position == 2048": [True, False, False, False],
            "goal_velocity != 1000": [False] * 4,
            "1300 < present_position": [False, False, False, True],
            "fields.torque == on": [False] * 4,
        },
    ),
    (
        [(frame(SEVERAL), b""), MOVED],  # a register of several servos
        {
            "goal_position == 512": [True, False, False],
            "goal_position == 515": [True, False, False],
            "goal_position > 500": [True, True, False],
            "not goal_position == 512": [False, True, True],
            "goal_position < goal_velocity": [False] * 3,
            "goal_velocity < goal_position and size == 2": [False] * 3,
            "goal_time < goal_position": [False, True, False],
            "goal_position & 3 == 3": [True, False, False],
        },
    ),
]


@pytest.mark.parametrize(("exchanges", "filters"), FILTERS)
def test_filters_find_registers(
    exchanges: list[tuple[bytes, bytes]], filters: dict[str, list[bool]]
) -> None:
    (batch,) = StreamDecoder(SERVO).feed(conversation(exchanges))
    assert isinstance(batch, ColumnBatch)

    for found in (batch, Records(list(batch.records()))):
        for text, rows in filters.items():
            chosen = compile_filter(text, SERVO).selection(found)
            assert found.in_order(chosen).tolist() == rows, text
