"""Frames of any layout in columns are the rows that one Session gives, however they are fed."""

from __future__ import annotations

from functools import cache
from random import Random

import pytest

from bilprov.analyzer.decode.batch import Records
from bilprov.analyzer.decode.column_batch import ColumnBatch
from bilprov.analyzer.decode.session import SKEW
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import Chunk
from bilprov.spec.protocol import Protocol
from tests.analyzer.decode.test_foreign_traffic import TRAFFIC
from tests.analyzer.decode.test_foreign_traffic import events as recorded
from tests.analyzer.decode.test_stream import same
from tests.support import ROOT
from tests.support.decoding import MS, Event
from tests.support.drawn_layouts import drawn_layout
from tests.support.framed_traffic import Traffic, exchanges

pytestmark = pytest.mark.usefixtures("columns_at_once")
EXAMPLES = ("relay_board", "roboclaw")  # their states follow from the requests
SHIPPED = ("modbus-rtu", "stk500v1", "dynamixel1", *EXAMPLES)
BOTH = frozenset({"host", "device"})


@cache
def protocol_of(name: str | int) -> Protocol:
    if isinstance(name, int):
        return drawn_layout(name).protocol
    return load_protocol(str(ROOT / "examples" / f"{name}.py") if name in EXAMPLES else name)


@pytest.mark.parametrize("name", SHIPPED)
def test_regular_traffic_is_columns_alone(name: str) -> None:
    events = exchanges(protocol_of(name), Random(1), 500, Traffic(odd=0, pipelined=3))

    parts = same(protocol_of(name), events, [70])

    assert {type(batch) for batch in parts} == {ColumnBatch}
    assert sum(batch.counts.frames for batch in parts) >= 500


@pytest.mark.parametrize("seed", range(40))
def test_regular_traffic_of_a_drawn_layout_is_columns_alone(seed: int) -> None:
    events = exchanges(protocol_of(seed), Random(seed), 60, Traffic(odd=0, pipelined=2))

    parts = same(protocol_of(seed), events, [1000])

    assert {type(batch) for batch in parts} == {ColumnBatch}


@pytest.mark.sample(20)
@pytest.mark.parametrize("seed", range(60))
@pytest.mark.parametrize("name", [*SHIPPED, None])
def test_odd_traffic_is_that_of_a_session(name: str | None, seed: int) -> None:
    random = Random(f"{name} {seed}")
    protocol = protocol_of(name or seed)
    how = Traffic(random.choice([0.02, 0.1, 0.3]), random.choice([1, 3, 300]), random.randint(1, 3))
    events = exchanges(protocol, random, 60, how)
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


@pytest.mark.sample(6)
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("name", SHIPPED)
def test_answers_that_a_tap_stamps_before_their_requests_are_those_of_a_session(
    name: str, seed: int
) -> None:
    random = Random(f"early {name} {seed}")
    stamped: list[tuple[int, Event]] = []
    for event in exchanges(protocol_of(name), random, 40, Traffic(0.02, 9, 2)):
        early = random.choice([0, 1000, MS, 5 * MS, 19 * MS, 25 * MS])
        late = isinstance(event, Chunk) and event.direction == "device"
        stamped.append((max(0, event.t - early) if late else event.t, event))
    stamped.sort(key=lambda one: one[0])
    events = [
        Chunk(t, one.direction, one.data) if isinstance(one, Chunk) else one for t, one in stamped
    ]

    same(protocol_of(name), events, [random.choice([1, 7, 1000])], skew=random.choice([0, SKEW]))


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("name", list(TRAFFIC))
def test_recorded_traffic_is_columns_alone(name: str, single: bool) -> None:
    protocol = protocol_of(TRAFFIC[name][0])

    parts = same(protocol, list(recorded(name, single=single)), [50])

    assert not any(isinstance(batch, Records) for batch in parts)
