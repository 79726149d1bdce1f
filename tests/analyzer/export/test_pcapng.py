"""Export as pcapng: a packet for each frame, answer and line event, and every byte in it."""

from __future__ import annotations

import subprocess
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bilprov.analyzer.decode.batch import Records
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.output.outputs import Window
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.spec.protocol import Protocol
from tests.support.decoding import Event, capture_session, conversation, decoded
from tests.support.expressions import expressions
from tests.support.firmware import needs
from tests.support.traffic import ACTS, SETTINGS, Acts, played
from tests.support.wireshark import WALL, blocks, capture_of, exported, options, packets

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("columns_at_once")]

TX, RX, TX_END, RX_END = 1, 2, 3, 4  # the link type's events
HOST, DEVICE = {TX, TX_END}, {RX, RX_END}


def file_of(
    folder: pytest.TempPathFactory, protocol: Protocol, acts: Acts, chosen: dict[str, Any]
) -> Path:
    """A capture of random traffic, its times from 0 on, with random settings."""
    events = played(protocol, acts)
    first = min((event.t for event in events), default=0)
    moved = [event.__class__(event.t - first, *_rest(event)) for event in events]
    about = {
        "heard": " ".join(sorted(chosen["heard"])),
        "attached": "yes" if chosen["attached"] else "no",
        "skew_ms": str(chosen["skew"] / MS),
    }
    if chosen["timeout"]:
        about["truncation_timeout_ms"] = str(chosen["timeout"] / MS)
    return capture_of(folder.getbasetemp() / "random.mcap", protocol, moved, **about)


def _rest(event: Event) -> tuple[Any, ...]:
    return tuple(getattr(event, name) for name in event.__struct_fields__[1:])


@pytest.mark.sample(1)
@given(acts=ACTS, chosen=SETTINGS)
@settings(max_examples=40)
def test_it_has_every_byte_and_a_packet_for_each_frame_answer_and_line_event(
    each_protocol: Protocol,
    tmp_path_factory: pytest.TempPathFactory,
    acts: Acts,
    chosen: dict[str, Any],
) -> None:
    path = file_of(tmp_path_factory, each_protocol, acts, chosen)
    capture = open_capture(path)
    events = list(capture.events())
    records = decoded(capture_session(capture, each_protocol), events)

    found = packets(exported(path, each_protocol))

    for side, ways in (("host", HOST), ("device", DEVICE)):
        carried = b"".join(packet.data for packet in found if packet.event in ways)
        assert carried == b"".join(
            event.data for event in events if isinstance(event, Chunk) and event.direction == side
        )
    paired = chosen["heard"] >= {"host", "device"}
    assert [(p.wall - WALL, p.event, p.data) for p in found if p.event in HOST and p.data] == [
        (r.end, TX_END if r.judgement is None else TX, r.data)
        for r in records
        if isinstance(r, HostRecord)
    ]
    assert [p.wall - WALL for p in found if p.event in HOST and not p.data] == [
        r.known for r in records if isinstance(r, HostRecord) and r.kind == "truncated"
    ]
    assert [(p.wall - WALL, p.event, p.data) for p in found if p.event in DEVICE] == [
        (r.t, RX_END if r.instruction is None and paired else RX, bytes([r.byte]))
        for r in records
        if isinstance(r, DeviceRecord)
    ]
    lines = [event for event in events if isinstance(event, Line)]
    assert len(lines) == sum(packet.event not in HOST | DEVICE for packet in found)
    assert found == sorted(found, key=attrgetter("wall"))


WINDOWS = st.sampled_from([None, 0, 1, MS, 100 * MS, 2_000 * MS])


@given(data=st.data(), acts=ACTS, chosen=SETTINGS, first=WINDOWS, after=WINDOWS)
@settings(max_examples=20)
def test_a_filter_and_a_window_choose_as_elsewhere_and_an_instruction_brings_its_answer(
    protocol: Protocol,
    tmp_path_factory: pytest.TempPathFactory,
    data: st.DataObject,
    acts: Acts,
    chosen: dict[str, Any],
    first: int | None,
    after: int | None,
) -> None:
    path = file_of(tmp_path_factory, protocol, acts, chosen)
    expression = data.draw(expressions(protocol))
    window = Window(first, after)

    found = packets(exported(path, protocol, expression, window))

    capture = open_capture(path)
    batch = Records(decoded(capture_session(capture, protocol), capture.events()))
    inside = batch.inside(first, after)
    passing = inside & compile_filter(expression, protocol).selection(batch)
    asked: set[int | None] = set()
    expected: list[tuple[bytes, bool]] = []
    paired = chosen["heard"] >= {"host", "device"}
    rows = zip(batch.records(), batch.in_order(inside), batch.in_order(passing), strict=True)
    for record, is_inside, passes in rows:
        if isinstance(record, HostRecord) and passes:
            asked |= {record.sequence} - {None}
            expected.append((record.data, record.sequence is None))
        elif isinstance(record, DeviceRecord):
            brought = is_inside and record.instruction in asked
            if brought or passes:
                expected.append((bytes([record.byte]), paired and not brought))
    assert sorted((p.data, p.event in (TX_END, RX_END)) for p in found if p.data) == sorted(
        expected
    )


def test_of_pipelined_traffic_every_chosen_instruction_brings_its_own_answer(
    protocol: Protocol, tmp_path: Path
) -> None:
    # The last one of those that are sent at once is chosen, and goes unanswered.
    frames = [bytes([0x81, at % 8]) for at in range(2_998)]
    events: list[Event] = [Chunk(0, "host", b"".join(frames[:4]))]
    for at, frame in enumerate(frames[4:], 1):  # four always wait
        events += [Chunk(at * MS, "host", frame), Chunk(at * MS, "device", b"\0")]
    t = 3_000 * MS
    events += [Chunk(t + 2_000 * MS, "host", b"\x81\x05"), Chunk(t + 2_001 * MS, "device", b"\0")]
    path = capture_of(tmp_path / "p.mcap", protocol, events)

    found = packets(exported(path, protocol, "rgb == 5"))

    chosen = frames.count(b"\x81\x05")
    answers = [packet for packet in found if packet.data == b"\0"]
    assert sum(packet.data == b"\x81\x05" for packet in found) == chosen + 1
    assert len(answers) == chosen
    assert len(found) == 2 * chosen + 1
    assert {packet.event for packet in answers} == {RX}


def test_line_events_have_the_types_of_the_link_and_comments_for_the_rest(
    protocol: Protocol, tmp_path: Path
) -> None:
    events: list[Event] = [
        Line(0, "open", "", "host a device b"),
        Chunk(10, "host", b"\x20"),
        *(
            Line(1_000 * at, word, "device", "7 \x1b[31m")
            for at, word in enumerate(
                ("framing", "parity", "break", "overrun", "gap", "unplugged", "reconnected"), 1
            )
        ),
        Line(9_000, "modem", "device", "CTS DSR"),
        Chunk(10_000, "device", b"\0"),
        Line(11_000, "close"),
    ]

    found = packets(exported(capture_of(tmp_path / "l.mcap", protocol, events), protocol))

    assert [(p.event, p.interface) for p in found] == [
        (0, 0),
        (TX, 0),
        *((event, 1) for event in (7, 8, 9, 10, 5, 0, 5, 0)),
        (RX_END, 1),
        (6, 0),
    ]
    assert found[0].comment == "open: host a device b"
    assert found[6].comment == "gap: 7 \\x1b[31m"
    assert found[7].comment == "unplugged: 7 \\x1b[31m"
    assert found[8].comment == "reconnected: 7 \\x1b[31m"
    assert found[10].comment == "may answer an instruction around the lost bytes"
    assert found[11].comment == "close"


def test_times_are_wall_clock_in_ns_and_the_file_says_what_made_it(
    protocol: Protocol, tmp_path: Path
) -> None:
    t = 1_234_567_891
    path = capture_of(tmp_path / "t.mcap", protocol, [Chunk(t, "host", b"\x20")], port_pty="\x1b")

    data = exported(path, protocol)

    (packet,) = packets(data)
    assert packet.wall == WALL + t
    assert packet.seconds * 10**6 + packet.microseconds == (WALL + t) // 1000
    assert packet.footer == 0
    assert [kind for kind, _ in blocks(data)] == [0x0A0D0D0A, 1, 1, 6]
    (section, host, device, _) = blocks(data)
    about = options(section[1][16:])
    assert about[4].decode().startswith("bilprov ")
    assert protocol.sha256 in about[1].decode()
    assert "pty \\x1b" in about[1].decode()
    for (kind, body), name, port in ((host, b"host", b"USB0"), (device, b"device", b"USB1")):
        said = options(body[8:])
        assert (kind, body[:2], said[2], said[9]) == (1, b"\xfa\x00", name, b"\x09")
        assert said[3] == b"/dev/tty" + port + b", 9600 8E1"
        assert int.from_bytes(said[8], "little") == 9600


@needs("tshark", package="tshark")
@pytest.mark.waits
def test_tshark_reads_it_without_the_dissector(protocol: Protocol, tmp_path: Path) -> None:
    events = [*conversation([(b"\x81\x05", b"\0")]), Line(60 * MS, "parity", "host", "1 counted")]
    file = tmp_path / "x.pcapng"
    file.write_bytes(exported(capture_of(tmp_path / "x.mcap", protocol, events), protocol))

    names = ["frame.time_epoch", "frame.interface_name", "rtacser.eventtype", "data.data"]
    asked = [part for name in (*names, "frame.comment") for part in ("-e", name)]
    done = subprocess.run(
        ["tshark", "-r", file, "-T", "fields", *asked],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )

    assert [line.split("\t") for line in done.stdout.splitlines()] == [
        ["1790000000.143456789", "host", "0x01", "8105", ""],
        ["1790000000.144456789", "device", "0x02", "00", ""],
        ["1790000000.183456789", "host", "0x08", "", "parity: 1 counted"],
    ]
