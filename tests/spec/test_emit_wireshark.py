"""The Wireshark dissector that is generated from the grammar, run by the real tshark."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Sequence
from decimal import Decimal
from pathlib import Path
from random import Random

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record
from bilprov.analyzer.grammar_file import dissector_program, load_protocol
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.codec import all_data, bad_data, build, judge, raw_frame
from bilprov.spec.emit.wireshark import lua_dissector
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.replies import build_reply
from tests.support.decoding import Event, capture_session, decoded
from tests.support.drawn_layouts import drawn_layout
from tests.support.framed_traffic import FRAMED, WITH_SYNC, Traffic, exchanges
from tests.support.grammars import checked_digits
from tests.support.traffic import ACTS, Acts, played
from tests.support.wireshark import Tshark, capture_of, exported, reads
from tests.vectors_checks import CHECKS, DIGITS

pytestmark = [pytest.mark.slow, pytest.mark.waits]


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
            for data in (*list(all_data(spec))[::7], *list(bad_data(spec))[::7]):
                yield raw_frame(protocol, spec.id, spec.length, data)


Told = tuple[list[tuple[object, ...]], list[tuple[object, ...]], list[str]]
"""The frames of the host, those of the device, and the bytes that are garbage."""


def shown(tshark: Tshark, data: bytes, variables: Sequence[str]) -> Told:
    """What tshark shows of each frame, with the predicted value of these variables."""
    names = ["data", "kind", "sequence", "outcome", "name", "reason", "latency", "response_to"]
    names += ["agrees", *(f"state.{variable}" for variable in variables)]
    rows = [
        {name.removeprefix(f"{tshark.word}."): value for name, value in row.items()}
        for row in tshark.rows(data, "frame.number", *(f"{tshark.word}.{name}" for name in names))
    ]
    sequences = {row["frame.number"]: row["sequence"] for row in rows}
    asked = [
        (
            *(row[name] for name in ("kind", "sequence", "outcome", "name", "reason")),
            *(row[f"state.{variable}"] for variable in variables),
        )
        for row in rows
        if row["outcome"]
    ]
    told = [
        (
            sequences.get(row["response_to"], ""),
            round(Decimal(row["latency"] or 0) * 1_000_000_000),
            row["agrees"],
        )
        for row in rows
        if row["kind"] == "response"
    ]
    return asked, told, [row["data"] for row in rows if row["kind"] == "garbage"]


def recorded(records: list[Record], variables: Sequence[str]) -> Told:
    """The same as the kit's own records have it."""
    asked, told, garbage = list[tuple[object, ...]](), list[tuple[object, ...]](), list[str]()
    for record in records:
        if isinstance(record, DeviceRecord):
            paired = record.instruction is not None
            words = (str(record.instruction), str(int(record.agrees))) if paired else ("", "")
            told.append((words[0], record.latency or 0, words[1]))
        elif isinstance(record, HostRecord) and record.judgement:
            judged, state = record.judgement, record.state
            frame = (record.kind, str(record.sequence), judged.outcome.value, judged.name)
            values = [getattr(state, variable) for variable in variables]
            words = ["" if v is None else str(int(v) if v in (0, 1) else v) for v in values]
            asked.append((*frame, judged.reason, *words))
        elif isinstance(record, HostRecord):
            garbage.append(record.data.hex())
    return asked, told, garbage


VARIABLES = ("motion", "speed", "steering", "led", "moving")
LONG = 5_000 * MS


@pytest.mark.sample(1)
@settings(max_examples=3, phases=[Phase.generate])  # to shrink would start too many programs
@given(lives=st.lists(ACTS, min_size=1, max_size=5), attached=st.booleans())
def test_it_pairs_and_follows_the_state_as_the_kit_does(
    each_protocol: Protocol,
    tmp_path_factory: pytest.TempPathFactory,
    lives: list[Acts],
    attached: bool,
) -> None:
    folder = tmp_path_factory.mktemp("random")
    # Much in one file: to start tshark takes longer than to dissect thousands of packets.
    events = list[Event]()
    for acts in lives:
        begin = LONG + max((event.t for event in events), default=0)
        events += [replace(event, t=begin + event.t) for event in played(each_protocol, acts)]
    path = capture_of(
        folder / "random.mcap",
        each_protocol,
        events,
        attached="yes" if attached else "no",
    )

    capture = open_capture(path)
    session = capture_session(capture, each_protocol)
    records = decoded(session, capture.events())

    data = exported(path, each_protocol)
    assert shown(Tshark(folder, each_protocol), data, VARIABLES) == recorded(records, VARIABLES)


@pytest.mark.sample(1)
def test_every_frame_gets_the_verdict_of_the_grammar_and_may_be_cut_over_packets(
    each_protocol: Protocol, tmp_path: Path
) -> None:
    tshark, whole = Tshark(tmp_path, each_protocol), list[Chunk]()
    for turn, frame in enumerate(every_frame(each_protocol)):  # some are answered early
        judgement, t = judge(each_protocol, frame), turn * 100 * MS
        answered = t + (30 + turn % 40 if judgement.truncated else 1) * MS
        whole.append(Chunk(t, "host", frame))
        whole.append(Chunk(answered, "device", bytes([judgement.response.code])))
    single = [Chunk(one.t, one.direction, bytes([byte])) for one in whole for byte in one.data]
    capture = open_capture(capture_of(tmp_path / "all.mcap", each_protocol, whole))
    records = decoded(capture_session(capture, each_protocol), capture.events())

    once = shown(tshark, exported(Path(capture.path), each_protocol), VARIABLES)
    assert once == recorded(records, VARIABLES)
    assert shown(tshark, reads(single), VARIABLES) == once


def test_a_packet_may_hold_many_frames(protocol: Protocol, tmp_path: Path) -> None:
    tshark = Tshark(tmp_path, protocol)
    frames = [b"\x11\x50", b"\x20", b"\x81\x09", b"\x90", b"\x81"]
    said = [Chunk(0, "host", b"".join(frames)), Chunk(MS, "device", b"\0\0\2\1")]
    said += [Chunk(10 * MS, "host", b"\x05\0"), Chunk(11 * MS, "device", b"\0\0")]

    lines = tshark(reads(said)).splitlines()

    shown = [line.partition("robot-car 1.1 ")[2].split(" ", 1)[1] for line in lines]
    assert shown == [
        "Speed speed=80; Forward; LED rgb=9: BAD_DATA, LED.rgb is 9, allowed are 0 to 7 (frame 81 "
        "09, byte 1); unused 9, 0 data bytes: BAD_HEADER, no instruction has ID 9, used are 0, 1, "
        "2, 3, 4, 5, 6, 7, 8; beginning of a frame of 2 bytes",
        "OK to Speed speed=80; OK to Forward; BAD_DATA to LED rgb=9; BAD_HEADER to unused 9, 0 data"
        " bytes",
        "LED rgb=5 (R B); Stop",
        "OK to LED rgb=5 (R B); OK to Stop",
    ]


def test_what_is_odd_has_an_expert_info(protocol: Protocol, tmp_path: Path) -> None:
    said = [
        Chunk(0, "device", b"\0"),
        Chunk(100 * MS, "host", b"\x20"),
        Chunk(101 * MS, "device", b"\1"),
        Chunk(300 * MS, "host", b"\x20"),
        Chunk(500 * MS, "device", b"\x07"),
        Chunk(1_000 * MS, "host", b"\x20"),
        Chunk(3_000 * MS, "device", b"\0"),
        Chunk(4_000 * MS, "host", b"\x11"),
    ]

    rows = Tshark(tmp_path, protocol).rows(reads(said), "_ws.expert.message")

    assert [row["_ws.expert.message"] for row in rows] == [
        "",
        "",
        "The device says BAD_HEADER to Forward, expected is OK",
        "",
        "Unused response|The device says unused 7 to Forward, expected is OK"
        "|After 200.0 ms, allowed are 100",
        "No response",
        "It responds to no instruction",
        "Speed: 1 data byte announced, 0 came",
    ]


def test_the_preferences_change_the_time_out_or_leave_the_packets_alone(
    protocol: Protocol, tmp_path: Path
) -> None:
    tshark = Tshark(tmp_path, protocol)
    data = reads([Chunk(0, "host", b"\x11"), Chunk(20 * MS, "host", b"\x20")])

    usual, strict = tshark(data), tshark(data, "-o", "robot_car.truncation_timeout:15000")
    alone = tshark(data, "-o", "robot_car.take:FALSE", "-O", "data")

    assert "Speed speed=32" in usual
    assert "Forward" in strict
    assert "robot-car" not in alone
    assert "Data: 11" in alone


def test_a_grammar_with_any_names_gives_a_script_that_runs(
    grammar_text: str, tmp_path: Path
) -> None:
    odd = grammar_text.replace('NAME = "robot-car"', 'NAME = "]] \\"Bil\\" 4 \\\\"')
    for old, new in (
        ('1: "Speed"', '1: "State"'),
        ('2: "Forward"', '2: "For-ward%d"'),
        ('3: "Backward"', '3: "For*ward%D"'),
        ('7: "RotateLeft"', '7: "Håll--[["'),
        ('bits="RGB"', 'bits="rR"'),
        ("Changes the colours", "Changes --]] the colours"),
    ):
        assert odd.count(old) == 1, old
        odd = odd.replace(old, new)
    protocol = load(odd)
    data = reads([Chunk(0, "host", b"\x11\x05\x20\x30\x70\x81\x02")])

    tshark = Tshark(tmp_path, protocol)
    names = [f"x_bil_4.{name}" for name in ("state_.speed", "name", "led.rgb.r", "led.rgb.r_")]
    (row,) = tshark.rows(data, *names)

    assert [row[name] for name in names] == [
        "5",
        "State|For-ward%d|For*ward%D|Håll--[[|LED",
        "1",
        "0",
    ]


def test_a_number_that_lua_cannot_hold_is_shown_as_bytes(grammar_text: str, tmp_path: Path) -> None:
    wide = grammar_text.replace("BitStruct, Byte,", "BitStruct, Byte, Int64ub,").replace(
        '"speed" / Ranged(Byte, 0, 255)', '"speed" / Ranged(Int64ub, 0, 255)'
    )
    tshark = Tshark(tmp_path, load(wide))
    data = reads([Chunk(0, "host", bytes([0x18, 0, 0, 0, 0, 0, 0, 0, 5]))])

    (row,) = tshark.rows(data, "robot_car.speed.speed", "robot_car.state.speed")

    assert [*row.values()] == ["0000000000000005", ""]  # and the speed is not known


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    "protocol",
    [
        *(load_protocol(name) for name in ("modbus-rtu", "stk500v1", "dynamixel1")),
        *(load(text) for text in (FRAMED["relay_board"], FRAMED["roboclaw"], WITH_SYNC)),
        *(drawn_layout(seed).protocol for seed in (*range(0, 200, 40), 58, 77)),
    ],
    ids=lambda protocol: protocol.name,
)
@pytest.mark.parametrize("odd", [0, 0.2])
def test_frames_of_any_layout_are_read_as_the_kit_reads_them(
    protocol: Protocol, odd: float, tmp_path: Path
) -> None:
    traffic = exchanges(protocol, Random(7), 60, Traffic(odd))
    events = [event for event in traffic if isinstance(event, Chunk)]
    capture = capture_of(tmp_path / "line.mcap", protocol, events)
    records = decoded(capture_session(open_capture(capture), protocol), events)
    tshark = Tshark(tmp_path, protocol)

    reported = {
        part.reports.variable
        for spec in protocol.instructions
        for part in (spec.answer.fields if spec.answer else ())
        if part.reports
    }
    # What odd bytes answer is a guess, and the dissector may make another.
    sure = [name for name in protocol.variables if not (odd and name in reported)]

    asked, told, _ = shown(tshark, exported(capture, protocol), sure)
    expected, answers, _ = recorded(records, sure)

    assert asked == expected
    assert len(told) == len(answers) > 0
    assert odd or told == answers


def test_the_values_of_any_layout_are_fields_of_display_filters(tmp_path: Path) -> None:
    protocol = load_protocol("modbus-rtu")
    request = build(protocol, "ReadHoldingRegisters", {"address": 17, "start": 107, "quantity": 3})
    answer = build_reply(protocol, judge(protocol, request), {"values": (555, 0, 100)})
    damaged = request[:-1] + bytes([request[-1] ^ 1])
    events = [
        Chunk(0, "host", request),
        Chunk(MS, "device", answer),
        Chunk(1000 * MS, "host", damaged),
    ]
    data = exported(capture_of(tmp_path / "line.mcap", protocol, events), protocol)
    tshark = Tshark(tmp_path, protocol)

    fields = ["address", "id", "crc", "read_holding_registers.start", "check_good", "reason"]
    answered = "modbus_rtu.read_holding_registers.answer.values"
    rows = tshark.rows(data, *(f"modbus_rtu.{one}" for one in fields), answered)

    assert [list(row.values()) for row in rows] == [
        ["17", "3", "0x8776", "107", "1", "", ""],
        ["17", "3", "0xbac8", "", "1", "", "555|0|100"],
        ["17", "3", "0x8676", "", "0", "crc is 76 86, right is 76 87", ""],
    ]
    shown = tshark(data, "-Y", f"{answered} == 555")
    assert shown.endswith("@17 answer values=555 0 100 to ReadHoldingRegisters\n")
    assert shown.count("\n") == 1


def test_the_checks_of_the_script_are_the_published_ones(tmp_path: Path) -> None:
    program = dissector_program()
    lines = [program[program.index("-- Checks") : program.index("local function covered")]]
    for one in CHECKS:
        protocol, _ = checked_digits(one, "big")
        check = "GRAMMAR.frame.check"
        told = f'print("value", FUNCTIONS[{check}.kind]({check}, "{DIGITS.decode()}"))'
        lines.append(f"do {lua_dissector(protocol, 20, told)} end")
    script, nothing = tmp_path / "checks.lua", tmp_path / "nothing.pcapng"
    script.write_text("\n".join(lines), encoding="utf-8")
    nothing.write_bytes(reads([]))

    words = ["tshark", "-r", nothing, "-X", f"lua_script:{script}"]
    told = subprocess.run(words, capture_output=True, text=True, check=True).stdout

    values = [float(line.split()[1]) for line in told.splitlines() if line.startswith("value")]
    assert values == [one.value for one in CHECKS]
