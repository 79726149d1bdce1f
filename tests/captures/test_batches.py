"""Events in batches: as arrays, and of any capture."""

from __future__ import annotations

import random
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from bilprov.captures.errors import CaptureError
from bilprov.captures.parts import part_path
from bilprov.captures.reader import open_capture, open_front, open_indexed
from bilprov.captures.schemas import Checkpoint, Chunk, Line
from bilprov.captures.storage import records
from bilprov.captures.storage.blocks import message_starts
from bilprov.captures.topics import TOPICS, CarLook, Written, encoded, topic_of
from bilprov.captures.writer import CaptureWriter
from tests.support.car import car_state

START = 1_790_000_000_000_000_000
VALUES: list[Written] = [
    Line(0, "gap", "", "10 bytes"),
    Line(0, "modem", "host", "cts"),
    car_state("forward", 1, 0, 0),
    CarLook(0, True),
    Checkpoint.of(0, "a" * 64, "{}"),
    Checkpoint.of(0, "a" * 64, "{}", resumes=True),
]


def written_by_us(path: Path, choose: random.Random, length: int, parts: int) -> None:
    calm = choose.choice([0.0, 0.05, 0.9])
    writer = CaptureWriter(
        part_path(path, 1) if parts else path, start_wall=START, metadata={}, version="1"
    )
    for number in range(max(1, parts)):
        if number:
            writer.go_on_in(part_path(path, number + 1), {"part": str(number + 1)})
            if choose.random() < 0.7:
                writer.write(VALUES[-1], 0)
        for t in range(length):
            if choose.random() < calm:
                writer.write(choose.choice(VALUES), t)
            else:
                size = choose.choice([0, 1, 1, 2, 50])
                writer.chunk(Chunk(t, choose.choice(["host", "device"]), choose.randbytes(size)))
            if choose.random() < 0.05:
                writer.flush()
    if choose.random() < 0.8:
        writer.close()
    else:
        writer.flush()
        writer._file.close()


def written_by_others(path: Path, choose: random.Random, length: int) -> None:
    options: dict[str, Any] = choose.choice(
        [
            {"use_chunking": False},
            {"compression": CompressionType.NONE, "chunk_size": 500},
            {"compression": CompressionType.LZ4, "chunk_size": 5000},
            {"compression": CompressionType.ZSTD, "chunk_size": 9000, "use_crc": False},
        ]
    )
    with path.open("wb") as file:
        options.pop("use_crc", None)
        writer: Any = Writer(file, **options)
        writer.start("", choose.choice(["another", "bilprov 1"]))
        ids = [writer.register_channel(topic.name, topic.encoding, 0) for topic in TOPICS]
        jitter = choose.choice([0, 0, 30, 10_000])
        start = choose.choice([5, START, (1 << 64) - 100_000])
        skipped = choose.choice([0.0, 0.0, 0.01])
        sequence = 0
        for t in range(length):
            log_time = start + 10 * t + choose.randrange(jitter + 1)
            sequence += 1 + (choose.random() < skipped)
            draw = choose.random()
            if draw < 0.9:
                channel, data = choose.choice(ids[:2]), choose.randbytes(choose.choice([1, 2, 9]))
            elif draw < 0.99:
                value = choose.choice(VALUES)
                channel, data = ids[topic_of(type(value)).channel - 1], encoded(value)
            else:
                channel, data = ids[choose.choice([0, 6])], choose.choice([b"{", bytes(70_000)])
            writer.add_message(channel, log_time, data, log_time, sequence=sequence - 1)
        if choose.random() < 0.8:
            writer.finish()


def damage(path: Path, choose: random.Random) -> None:
    data = bytearray(path.read_bytes())
    way = choose.choice(["none", "none", "cut", "flip", "zero", "out", "twice"])
    at = choose.randrange(len(data))
    if way == "cut":
        del data[at:]
    elif way == "flip":
        data[at] ^= 1 << choose.randrange(8)
    elif way == "zero":
        data[at : at + 200] = bytes(len(data[at : at + 200]))
    elif way == "out":
        del data[at : at + choose.choice([1, 300])]
    elif way == "twice":
        data[at:at] = data[at - 3000 if at > 3000 else 8 : at]
    path.write_bytes(bytes(data))


def drawn(folder: Path, choose: random.Random, length: int) -> Path:
    path = folder / "a.mcap"
    parts = choose.choice([0, 0, 3])
    if choose.random() < 0.5:
        written_by_us(path, choose, length, parts)
        files = [part_path(path, n + 1) for n in range(parts)] or [path]
    else:
        written_by_others(path, choose, length)
        files = [path]
    damage(choose.choice(files), choose)
    return path


@pytest.mark.slow
@settings(max_examples=100)
@given(seed=st.integers(0, 1 << 64), length=st.sampled_from([0, 1, 20, 300]))
def test_the_batches_of_any_capture_hold_its_events_and_its_front_gives_them_or_is_void(
    tmp_path_factory: pytest.TempPathFactory, seed: int, length: int
) -> None:
    choose = random.Random(seed)
    path = drawn(tmp_path_factory.mktemp("drawn"), choose, length)
    try:
        capture = open_capture(path)
    except CaptureError:
        with pytest.raises(CaptureError):
            open_front(path)
        return
    events = list(capture.events())
    assert single(capture) == events
    front = open_front(path)
    given = single(front)
    whole = front.whole()
    if whole is not None:
        assert (whole, given) == (capture, events)
    indexed = open_indexed(path)
    if indexed is None:
        return
    assert single(indexed) == list(indexed.events())
    found = indexed.checkpoint_before(choose.choice([10, 200, 1 << 62]))
    if found is not None:
        rest = [event for batch in indexed.batches(found) for event in batch.single()]
        assert rest == list(indexed.events(found))


def single(capture: Any) -> list[Any]:
    """The events of all batches."""
    return [event for batch in capture.batches() for event in batch.single()]


@dataclass
class Foreign:
    """A capture of another program, whose second chunk brings what the first does not tell."""

    start: dict[str, str] | None = None
    late: dict[str, str] | None = None
    late_channel: bool = False
    times: tuple[int, int] = (10, 20)

    def write(self, path: Path) -> Path:
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=1)
            writer.start("", "another")
            if self.start:
                writer.add_metadata("bilprov", self.start)
            host, device = (topic.name for topic in TOPICS[:2])
            ids = [writer.register_channel(host, "", 0)] * 2
            if not self.late_channel:
                ids[1] = writer.register_channel(device, "", 0)
            writer.add_message(ids[0], self.times[0], b"!", 0)
            if self.late_channel:
                ids[1] = writer.register_channel(device, "", 0)
            if self.late:
                writer.add_metadata("bilprov", self.late)
            writer.add_message(ids[1], self.times[1], b"!", 0)
            writer.finish()
        return path


def test_the_front_of_an_intact_capture_is_enough_to_read_it(tmp_path: Path) -> None:
    written_by_us(tmp_path / "own.mcap", random.Random(1), 300, 0)
    written_by_us(tmp_path / "kept.mcap", random.Random(1), 300, 3)
    foreign = Foreign(start={"start": "5"}).write(tmp_path / "foreign.mcap")

    for path in (tmp_path / "own.mcap", tmp_path / "kept.mcap", foreign):
        front = open_front(path)
        read = sum(1 for batch in front.batches() for _ in batch.single())
        assert front.surveys is not None
        assert front.whole() == open_capture(path)
        assert read == sum(1 for _ in open_capture(path))
        assert 0 < front.passed <= front.contents.size


@pytest.mark.parametrize(
    "foreign",
    [
        Foreign(late={"start": "5"}),
        Foreign(late={"line": "9600 8N1"}),
        Foreign(late_channel=True),
        Foreign(start={"start": "5"}, times=(20, 10)),
    ],
)
def test_a_front_that_does_not_tell_how_to_read_the_rest_is_void(
    tmp_path: Path, foreign: Foreign
) -> None:
    path = foreign.write(tmp_path / "a.mcap")

    front = open_front(path)

    assert front.surveys is not None
    assert len(list(front.batches())) > 0
    assert front.whole() is None
    assert len(list(open_capture(path))) == 2


@given(seed=st.integers(0, 1 << 64))
def test_an_index_that_lies_leads_to_the_same_messages_as_none(seed: int) -> None:
    choose = random.Random(seed)
    content, index = b"", b""
    for n in range(80):
        opcode = 4 if choose.random() < 0.01 else Opcode.MESSAGE
        body = choose.randbytes(choose.choice([22, 23, 23, 40]))
        if choose.random() < 0.003:
            body = body[:9]
        index += struct.pack("<QQ", n, len(content)) if opcode == Opcode.MESSAGE else b""
        content += records.RECORD_HEAD.pack(opcode, len(body)) + body
    content += bytes(choose.choice([0, 0, 8]))  # less than a record
    lying = bytearray(index)
    for _ in range(choose.choice([0, 0, 1, 2])):
        struct.pack_into(
            "<Q", lying, 16 * choose.randrange(70) + 8, choose.choice([0, 31, 1 << 63])
        )
    if choose.random() < 0.2:
        del lying[-16 * choose.randrange(1, 5) :]

    def found(entries: bytes) -> tuple[list[int], object] | str:
        try:
            starts, others = message_starts(content, entries)
        except records.Damaged as damage:
            return str(damage)
        return starts.tolist(), others

    assert found(bytes(lying)) == found(b"")
