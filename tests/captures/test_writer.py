"""Capture writer: its guarantees, tested with real files and killed processes."""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture, open_capture
from bilprov.captures.schemas import (
    Asked,
    CaseMark,
    Checkpoint,
    Chunk,
    Instruction,
    Line,
    Log,
    Response,
    Time,
)
from bilprov.captures.topics import CarLook
from bilprov.captures.wall_clock import EARLIEST, LATEST, wall_clock
from bilprov.captures.writer import FLUSH_AFTER, CaptureWriter
from tests.support import ROOT
from tests.support.car import car_state
from tests.support.messages import messages

START = 1_790_000_000_000_000_000
SECOND = 1_000_000_000

ONE_OF_EACH: list[topics.Written] = [
    Instruction(0, 5, "instruction", "81 05", 0, 1, "LED", 1, {"rgb": 5}, "OK", ""),
    Instruction(6, 7, "garbage", "ff", None, None, None, None, {}, None, "no header"),
    Response(8, "00", 0, "OK", 0, 3, True, ""),
    Response(9, "07", 7, None, None, None, None, "nothing asked"),
    car_state("forward", 9, -3, 7),
    Log(Time(1, 2), 3, "odd", "kind"),
    Line(10, "modem", "host", "cts on"),
    Line(11, "gap"),
    CaseMark(12, "valid/Speed/255", "begin"),
    CaseMark(13, "valid/Speed/255", "end", "pass", ""),
    CarLook(14, True, "forward", 9, 0, 7, 9, 9),
    CarLook(15, None),
    Asked(16, "look", 14),
    Asked(17, "interrupt", None, "interrupted", False, True),
    Checkpoint.of(18, "0" * 64, '{"framer":"a\\u00e5"}'),
]


def writer(path: Path, **metadata: str) -> CaptureWriter:
    return CaptureWriter(path, start_wall=START, metadata=metadata, version="0.1.0")


def child(script: str, *arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", script, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)


def chunks(capture: Capture) -> list[Chunk]:
    return [event for event in capture if isinstance(event, Chunk)]


events = st.lists(
    st.one_of(
        st.builds(
            Chunk,
            t=st.integers(0, 10 * SECOND),
            direction=st.sampled_from(["host", "device"]),
            data=st.binary(max_size=300),
        ),
        st.builds(
            Line,
            t=st.integers(0, 10 * SECOND),
            event=st.text(max_size=20) | st.just("gap"),
            tap=st.sampled_from(["host", "device", ""]),
            detail=st.text(max_size=20),
        ),
    ),
    max_size=60,
)


@pytest.mark.slow
@given(events=events)
@settings(max_examples=60, deadline=None)
def test_events_come_back_as_written_and_in_the_order_written(
    events: list[Chunk | Line], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("round") / "a.mcap"
    with writer(path) as capture:
        for event in events:
            if isinstance(event, Chunk):
                capture.chunk(event)
            else:
                capture.write(event, event.t)
    read = open_capture(path)
    assert list(read.recorded()) == events
    assert (read.damage, read.unfinished, read.start) == ((), False, START)


def test_a_read_larger_than_a_message_becomes_several_of_the_same_time(tmp_path: Path) -> None:
    data = bytes(range(256)) * 600
    with writer(tmp_path / "a.mcap") as capture:
        capture.chunk(Chunk(5, "device", data))
    read = chunks(open_capture(tmp_path / "a.mcap"))
    assert b"".join(chunk.data for chunk in read) == data
    assert {(chunk.t, chunk.direction) for chunk in read} == {(5, "device")}
    assert len(read) == 3


def test_a_value_too_large_for_a_message_is_left_out_and_said_in_faults(tmp_path: Path) -> None:
    with writer(tmp_path / "a.mcap") as capture:
        capture.write(Line(5, "modem", "host", "x" * 70_000), 5)
    (message,) = messages(open_capture(tmp_path / "a.mcap"))
    assert message.topic == "/faults"
    assert isinstance(message.value, dict)
    assert message.value["message"].startswith("/line: a message of 700")
    assert message.value["timestamp"] == {"sec": START // SECOND, "nsec": 5}


def test_an_existing_file_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(CaptureError, match=r"a\.mcap exists .*: choose another name"):
        writer(path)
    assert path.read_bytes() == b"precious"


def test_metadata_and_channels_are_in_the_file_before_the_first_message(tmp_path: Path) -> None:
    capture = writer(tmp_path / "a.mcap", grammar="robot car", ports="a, b")
    read = open_capture(tmp_path / "a.mcap")
    assert read.metadata == {"grammar": "robot car", "ports": "a, b", "start": str(START)}
    assert (read.contents.library, read.start, read.unfinished) == ("bilprov 0.1.0", START, True)
    assert (list(read), read.damage) == ([], ())
    capture.close()


def test_what_waited_for_a_tenth_of_a_second_is_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    capture = writer(path)
    capture.chunk(Chunk(0, "host", b"a"))
    capture.tick(FLUSH_AFTER - 1)
    assert chunks(open_capture(path)) == []
    capture.tick(FLUSH_AFTER)
    assert [chunk.data for chunk in chunks(open_capture(path))] == [b"a"]
    capture.chunk(Chunk(FLUSH_AFTER + 1, "host", b"b"))
    capture.chunk(Chunk(2 * FLUSH_AFTER + 1, "host", b"c"))
    assert [chunk.data for chunk in chunks(open_capture(path))] == [b"a", b"b", b"c"]
    capture.close()


def test_late_values_do_not_flush_one_by_one(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    capture = writer(path)
    capture.chunk(Chunk(SECOND, "host", b"a"))
    for _ in range(5):
        capture.write(car_state("stopped", 0, 0, 0), 0)
    assert list(messages(open_capture(path))) == []
    capture.close()


def test_closing_twice_is_once_and_writing_after_it_is_wrong_use(tmp_path: Path) -> None:
    capture = writer(tmp_path / "a.mcap")
    capture.close()
    capture.close()
    with pytest.raises(ValueError, match="is closed"):
        capture.chunk(Chunk(0, "host", b"x"))
    assert not open_capture(tmp_path / "a.mcap").unfinished


@pytest.mark.parametrize("t", [-START - 1, 1 << 64])
def test_a_time_that_the_format_cannot_hold_is_wrong_use(tmp_path: Path, t: int) -> None:
    with writer(tmp_path / "a.mcap") as capture, pytest.raises(ValueError, match="log time is"):
        capture.chunk(Chunk(t, "host", b"x"))


def test_a_file_deleted_while_recording_is_noticed_at_the_next_flush(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    capture = writer(path)
    capture.chunk(Chunk(0, "host", b"x"))
    path.unlink()
    with pytest.raises(CaptureError, match=r"the capture file .* was deleted while recording"):
        capture.flush()
    capture.close()


@pytest.mark.parametrize("size", [0, 100, 100_000])
def test_a_file_that_another_program_cuts_is_noticed_at_the_next_flush(
    tmp_path: Path, size: int
) -> None:
    path = tmp_path / "a.mcap"
    capture = writer(path)
    capture.chunk(Chunk(0, "host", b"x"))
    capture.flush()
    whole = path.stat().st_size
    os.truncate(path, size)
    capture.chunk(Chunk(1, "host", b"x"))
    with pytest.raises(CaptureError, match=r"another program made the capture file .* bytes long"):
        capture.flush()
    capture.close()
    kept = {0: 0, 100: 100}  # never made longer with zeros; what was appended is cut off
    assert path.stat().st_size == kept.get(size, whole)


KILLED = """
import sys
from bilprov.captures.schemas import Chunk
from bilprov.captures.writer import CaptureWriter
capture = CaptureWriter(sys.argv[1], start_wall=10**18, metadata={}, version="0")
flushed = 0
for t in range(0, 10**15, 7_000_000):
    capture.chunk(Chunk(t, "host", t.to_bytes(8, "big")))
    capture.tick(t)
    print(t, flush=True)
"""


def test_kill_9_loses_at_most_a_tenth_of_a_second(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    process = child(KILLED, path)
    assert process.stdout is not None
    with process.stdout as output:
        last = 0
        for _ in range(200):
            last = int(output.readline())
        process.kill()
        for line in output:
            last = int(line) if line.endswith("\n") else last
    assert process.wait() == -signal.SIGKILL
    read = open_capture(path)
    kept = chunks(read)
    assert read.unfinished
    assert read.damage == ()
    first_lost = kept[-1].t + 7_000_000
    assert last - first_lost < FLUSH_AFTER
    assert [chunk.t for chunk in kept] == list(range(0, kept[-1].t + 1, 7_000_000))
    assert all(chunk.data == chunk.t.to_bytes(8, "big") for chunk in kept)


LIMITED = """
import json, random, resource, signal, sys
from bilprov.captures.errors import CaptureError
from bilprov.captures.schemas import Chunk
from bilprov.captures.writer import CaptureWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
sys.dont_write_bytecode = True  # a compiled file would be cut short too
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
said = []
"""
FULL = """
capture = CaptureWriter(sys.argv[1], start_wall=10**18, metadata={}, version="0")
bytes_of = random.Random(1).randbytes
for t in range(0, 10**12, 50_000_000):
    try:
        capture.chunk(Chunk(t, "host", bytes_of(1000)))
    except CaptureError as error:
        said.append(str(error))
        if len(said) == 2:
            break
capture.close()
capture.close()
print(json.dumps([said, t]))
"""


def test_a_full_disk_is_one_sentence_and_keeps_what_was_flushed(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    process = child(LIMITED + FULL, path, 60_000)
    output, _ = process.communicate()
    said, last = json.loads(output)
    kept = chunks(open_capture(path))
    assert process.returncode == 0
    until = f"{kept[-1].t / SECOND:.1f}"
    assert said == [f"disk full: what was captured until {until} s is kept in {path}"] * 2
    assert last - 4 * FLUSH_AFTER < kept[-1].t < last
    assert open_capture(path).damage == ()
    assert open_capture(path).unfinished


END = """
with CaptureWriter(sys.argv[1], start_wall=10**18, metadata={}, version="0") as capture:
    capture.chunk(Chunk(0, "host", b"kept"))
    capture.flush()
    size = capture.size
    try:
        capture.close()
    except CaptureError as error:
        said.append(str(error))
print(json.dumps([said, size]))
"""


def test_a_disk_with_no_room_for_the_end_of_a_file_keeps_all_before_it(tmp_path: Path) -> None:
    whole = tmp_path / "whole.mcap"
    output, _ = child(LIMITED + END, whole, 1_000_000).communicate()
    said, size = json.loads(output)
    assert said == []
    for room in range(size, whole.stat().st_size, 4_000):
        path = tmp_path / f"{room}.mcap"
        output, _ = child(LIMITED + END, path, room).communicate()
        assert json.loads(output) == [
            [f"disk full: what was captured until 0.0 s is kept in {path}"],
            size,
        ]
        assert path.stat().st_size == size
        assert [chunk.data for chunk in chunks(open_capture(path))] == [b"kept"]
        assert (open_capture(path).damage, open_capture(path).unfinished) == ((), True)


def test_the_summary_and_the_indexes_say_what_is_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    times = [5, 3, 9, 4_000, 7]  # in file order, which need not be the order of times
    with writer(path) as capture:
        for n, t in enumerate(times * 900):
            capture.chunk(Chunk(t, "device" if n % 3 else "host", b"x" * (n % 5)))
        capture.attach("a.txt", "text/plain", b"attached", 6)
        capture.chunk(Chunk(8, "host", b"the last"))
    content = path.read_bytes()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        (attachment,) = reader.iter_attachments()
    assert (attachment.name, attachment.data, attachment.log_time) == (
        "a.txt",
        b"attached",
        START + 6,
    )
    assert summary is not None
    counted = summary.statistics
    assert counted is not None
    assert (counted.message_count, counted.channel_message_counts) == (4_501, {1: 1_501, 2: 3_000})
    assert (counted.message_start_time, counted.message_end_time) == (START + 3, START + 4_000)
    assert (counted.chunk_count, counted.attachment_count, counted.metadata_count) == (4, 1, 1)
    assert (counted.channel_count, counted.schema_count) == (11, 9)
    indexed = 0
    for chunk in summary.chunk_indexes:
        packed = content[chunk.chunk_start_offset :][: chunk.chunk_length][-chunk.compressed_size :]
        unpacked = zstandard.decompress(packed)
        assert len(unpacked) == chunk.uncompressed_size
        for channel, at in chunk.message_index_offsets.items():
            opcode, _, of, size = struct.unpack_from("<BQHI", content, at)
            assert (opcode, of) == (7, channel)
            for n in range(size // 16):
                time, place = struct.unpack_from("<QQ", content, at + 15 + 16 * n)
                kind, _, sender, _, log_time = struct.unpack_from("<BQHIQ", unpacked, place)
                assert (kind, sender, log_time) == (5, channel, time)
                assert chunk.message_start_time <= time <= chunk.message_end_time
                indexed += 1
    assert indexed == 4_501


@pytest.mark.parametrize("value", ONE_OF_EACH, ids=lambda v: type(v).__name__)
def test_messages_hold_what_their_schema_requires_no_null_and_their_times_twice(
    value: topics.Written,
) -> None:
    schema = json.loads(topics.json_schema(type(value)))
    message = json.loads(topics.encoded(value))
    kinds = {"string": str, "integer": int, "boolean": bool, "object": dict}
    assert set(schema["required"]) <= set(message) <= set(schema["properties"])
    for name, item in message.items():
        assert isinstance(item, kinds[schema["properties"][name]["type"]])
    for name in ("t", "latency"):
        assert message.get(name) == message.get(f"{name}_ns") == getattr(value, f"{name}_ns", None)
        assert (name in schema["required"]) == (f"{name}_ns" in schema["required"])


def test_topics_have_the_channels_that_they_always_had() -> None:
    """A file that has lost its table is read by these; names and schemas stand in transcripts."""
    assert [(topic.channel, topic.name.rpartition("/")[2]) for topic in topics.TOPICS] == [
        *((1, "raw"), (2, "raw"), (3, "instructions"), (4, "responses"), (5, "state")),
        *((6, "faults"), (7, "line"), (8, "cases"), (9, "looks"), (10, "asks"), (11, "checkpoint")),
    ]


@pytest.mark.parametrize(
    "change",
    [{"t": 6}, {"grammar": "h"}, {"decoder": "[1]"}, {"crc": 0}],
    ids=lambda change: next(iter(change)),
)
def test_a_checkpoint_with_any_part_changed_is_not_whole(change: dict[str, Any]) -> None:
    whole = Checkpoint.of(5, "g", "[]")
    assert whole.whole
    assert not msgspec.structs.replace(whole, **change).whole


@pytest.mark.parametrize("decoder", ["", "{", "[1,]", "[" * 100_000, "\ud800"])
def test_a_checkpoint_whose_state_is_not_json_is_not_whole(decoder: str) -> None:
    assert not Checkpoint.of(5, "g", decoder).whole


# -- a clock that is set wrong ---------------------------------------------------------------------


NOW = 1_790_000_000_000_000_000


def before_1970() -> int:
    return -3_600_000_000_000


def after_2262() -> int:
    """What Python does with a later time than it can give in ns."""
    raise OverflowError("timestamp out of range for platform time_t")


@pytest.mark.parametrize(
    ("clock", "start"), [(before_1970, EARLIEST), (after_2262, LATEST), (lambda: NOW, NOW)]
)
def test_a_capture_begins_at_the_limit_where_the_clock_is_beyond_it(
    clock: Callable[[], int], start: int, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    chunk = Chunk(5, "host", b"kept")
    with CaptureWriter(path, start_wall=wall_clock(clock), metadata={}, version="0") as writer:
        writer.chunk(chunk)
    capture = open_capture(path)
    assert (capture.start, list(capture)) == (start, [chunk])
