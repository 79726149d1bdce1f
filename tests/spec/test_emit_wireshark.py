"""The Wireshark dissector that is generated from the grammar, run by the real tshark."""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal
from itertools import chain, repeat
from pathlib import Path

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record
from bilprov.analyzer.replay.capture_session import capture_session
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.spec.codec import all_data, bad_data, judge, raw_frame
from bilprov.spec.emit.wireshark import lua_dissector
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol, load
from tests.support.commands import command
from tests.support.decoding import Event, decoded
from tests.support.traffic import ACTS, Act, played
from tests.support.wireshark import TSHARK, Tshark, capture_of, exported

pytestmark = [pytest.mark.slow, pytest.mark.waits, TSHARK]


@pytest.fixture
def tshark(each_protocol: Protocol, tmp_path: Path) -> Tshark:
    return Tshark(tmp_path, each_protocol)


def every_frame(protocol: Protocol) -> Iterator[bytes]:
    """Every header with every value of one byte of data, wrong lengths, every truncation.

    Of wider data each field's range, and what is out of it.
    """
    for header, length in enumerate(protocol.lengths):
        for came in range(length + 1):
            yield bytes([header]) + bytes(range(1, came + 1))
        if length == 1:
            yield from (bytes([header, value]) for value in range(256))
    for spec in protocol.instructions:
        if spec.length > 1:
            for data in (*all_data(spec, 40), *list(bad_data(spec))[::7]):
                yield raw_frame(protocol, spec.id, spec.length, data)


def test_every_frame_gets_the_verdict_of_the_grammar(
    each_protocol: Protocol, tshark: Tshark, tmp_path: Path
) -> None:
    frames = list(every_frame(each_protocol))
    judgements = [judge(each_protocol, frame) for frame in frames]
    events: list[Event] = []
    for turn, (frame, judgement) in enumerate(zip(frames, judgements, strict=True)):
        t = turn * 100 * MS
        events.append(Chunk(t, "host", frame))
        answered = t + (60 if judgement.truncated else 1) * MS
        events.append(Chunk(answered, "device", bytes([judgement.response.code])))
    data = exported(capture_of(tmp_path / "all.mcap", each_protocol, events), each_protocol)

    names = ("kind", "outcome", "judgement", "reason", "id", "length", "name", "agrees")
    rows = tshark.rows(data, *(f"robot_car.{name}" for name in names))

    host = [row for row in rows if row["robot_car.outcome"]]
    assert [tuple(row[f"robot_car.{name}"] for name in names[:-1]) for row in host] == [
        (
            "truncated" if one.truncated else "instruction",
            one.outcome.value,
            str(one.response.code),
            one.reason,
            str(one.id),
            str(one.length),
            one.name,
        )
        for one in judgements
    ]
    assert [row["robot_car.agrees"] for row in rows if row["robot_car.agrees"]] == ["1"] * len(host)


def found(tshark: Tshark, data: bytes) -> tuple[list[tuple[object, ...]], list[str], list[str]]:
    """What tshark tells: of each instruction, the garbage, and the bytes that answer nothing."""
    names = ("data", "kind", "sequence", "latency", "response", "response_to", "response_in")
    variables = ("motion", "speed", "steering", "led", "moving")
    names += tuple(f"state.{variable}" for variable in variables)
    rows = [
        {name.removeprefix("robot_car."): value for name, value in row.items()}
        for row in tshark.rows(data, "frame.number", *(f"robot_car.{name}" for name in names))
    ]
    by_number = {row["frame.number"]: row for row in rows}
    instructions: list[tuple[object, ...]] = []
    for row in rows:
        if row["sequence"]:
            answer = by_number.get(row["response_in"])
            if answer:
                assert answer["response_to"] == row["frame.number"]
            instructions.append(
                (
                    int(row["sequence"]),
                    row["kind"],
                    *(row[f"state.{variable}"] for variable in variables),
                    answer and int(answer["response"]),
                    answer and round(Decimal(answer["latency"]) * 1_000_000_000),
                )
            )
    garbage = [row["data"] for row in rows if row["kind"] == "garbage"]
    stray = [row["response"] for row in rows if row["response"] and not row["latency"]]
    return instructions, garbage, stray


def told(records: list[Record]) -> tuple[list[tuple[object, ...]], list[str], list[str]]:
    """The same as the kit's own records have it."""
    answers = {record.instruction: record for record in records if isinstance(record, DeviceRecord)}
    instructions: list[tuple[object, ...]] = []
    for record in records:
        if isinstance(record, HostRecord) and record.sequence is not None:
            state, answer = record.state, answers.get(record.sequence)
            instructions.append(
                (
                    record.sequence,
                    record.kind,
                    state.motion,
                    *(str(number) for number in (state.speed, state.steering, state.led)),
                    str(int(state.moving)),
                    answer and answer.byte,
                    answer and answer.latency,
                )
            )
    garbage = [r.data.hex() for r in records if isinstance(r, HostRecord) and r.sequence is None]
    stray = [str(r.byte) for r in records if isinstance(r, DeviceRecord) and r.instruction is None]
    return instructions, garbage, stray


LONG = 5_000 * MS


@settings(max_examples=40, phases=[Phase.generate])  # to shrink would start too many programs
@given(lives=st.lists(ACTS, min_size=1, max_size=5), attached=st.booleans())
def test_it_pairs_and_follows_the_state_as_the_kit_does(
    each_protocol: Protocol,
    tmp_path_factory: pytest.TempPathFactory,
    lives: list[list[Act]],
    attached: bool,
) -> None:
    folder = tmp_path_factory.mktemp("random")
    # Much in one file: to start tshark takes longer than to dissect thousands of packets.
    acts = [
        act._replace(pause=LONG) if first else act
        for life in lives
        for act, first in zip(life, chain([True], repeat(False)), strict=False)
    ]
    path = capture_of(
        folder / "random.mcap",
        each_protocol,
        played(each_protocol, acts),
        attached="yes" if attached else "no",
    )

    capture = open_capture(path)
    session = capture_session(capture, each_protocol)
    records = decoded(session, capture.events())

    assert found(Tshark(folder, each_protocol), exported(path, each_protocol)) == told(records)
