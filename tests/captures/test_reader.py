"""Capture reader: damage loses data but never changes any, and foreign writers are understood."""

from __future__ import annotations

import os
import random
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk, Line
from bilprov.captures.storage import records, recovery
from bilprov.captures.storage.records import Damaged
from bilprov.captures.storage.recovery import RecordFile, parsed
from bilprov.captures.topics import TOPICS
from bilprov.captures.writer import CaptureWriter
from tests.support.captures import record_places
from tests.support.car import car_state
from tests.support.messages import Message, messages

START = 1_790_000_000_000_000_000
FLUSH_EVERY = 4


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A finished capture of 24 messages in 6 chunks, on four topics."""
    path = tmp_path / "small.mcap"
    with CaptureWriter(path, start_wall=START, metadata={"grammar": "g"}, version="1") as capture:
        for t in range(24):
            if t % 6 == 4:
                capture.write(Line(t, "modem", "host", f"cts {t}"), t)
            elif t % 6 == 5:
                capture.write(car_state("forward", t, 0, 0), t)
            else:
                data = b"%d " % t * (t % 3 + 1)
                capture.chunk(Chunk(t, "device" if t % 2 else "host", data))
            if t % FLUSH_EVERY == FLUSH_EVERY - 1:
                capture.flush()
    return path


def with_bytes(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def all_of(path: Path) -> list[Message]:
    return list(messages(open_capture(path)))


@pytest.mark.slow
def test_a_file_cut_anywhere_gives_a_prefix(small: Path, pytestconfig: pytest.Config) -> None:
    held = all_of(small)
    chunks = chunk_offsets(small.read_bytes())
    size = small.stat().st_size
    # Each byte of the data; the schemas before and behind are long and all alike.
    step = 1 if pytestconfig.getoption("--whole") else 7
    data = range(chunks[0], chunks[-1] + 900, step)
    cuts = {*range(0, size, 13 * step), *range(0, 300, step), *data, size - 1}
    lengths = []
    for cut in sorted(cuts & set(range(size)), reverse=True):
        os.truncate(small, cut)
        try:
            capture = open_capture(small)
        except CaptureError:
            lengths.append(0)
            continue
        read = list(messages(capture))
        assert read == held[: len(read)], cut
        assert capture.unfinished
        assert capture.damage == ()
        lengths.append(len(read))
    assert lengths == sorted(lengths, reverse=True)
    assert set(lengths) == set(range(0, 25, FLUSH_EVERY))


def chunk_offsets(data: bytes) -> list[int]:
    return [at for at, _ in record_places(data, Opcode.CHUNK)]


def without_record(data: bytes, opcode: int, number: int) -> bytes:
    """A capture without the record of this opcode that stands there at this place of all."""
    first, end = record_places(data, opcode)[number]
    return data[:first] + data[end:]


@pytest.mark.parametrize("lost", [0, 3, -1])
def test_a_chunk_that_was_taken_out_is_missed_by_the_statistics(
    small: Path, tmp_path: Path, lost: int
) -> None:
    data = without_record(small.read_bytes(), Opcode.CHUNK, lost)
    capture = open_capture(with_bytes(tmp_path / "out.mcap", data))
    assert capture.damage == ("20 messages are there, the file's statistics count 24",)
    gaps = [event.detail for event in capture if isinstance(event, Line) and event.event == "gap"]
    told = "4 messages are lost here, the file is damaged"
    assert gaps == ([] if lost == -1 else [told])


def test_a_message_taken_out_of_a_foreign_file_without_chunks_is_missed(tmp_path: Path) -> None:
    path = foreign(tmp_path / "f.mcap", two_taps, use_chunking=False)
    before = open_capture(path)
    held = sum(before.contents.counts.values())
    path.write_bytes(without_record(path.read_bytes(), Opcode.MESSAGE, 0))
    told = f"{held - 1} messages are there, the file's statistics count {held}"
    assert told in open_capture(path).damage
    assert not any("statistics" in sentence for sentence in before.damage)


STATISTICS = [struct.pack("<BQ", Opcode.STATISTICS, 46 + 10 * n) for n in range(1, 9)]


def test_statistics_that_are_cut_short_are_damage_and_no_more(tmp_path: Path) -> None:
    path = foreign(tmp_path / "f.mcap", two_taps)
    data, held = path.read_bytes(), all_of(path)
    at = next(n for n in range(len(data)) if data[n : n + 9] in STATISTICS)
    short = data[:at] + struct.pack("<BQ", Opcode.STATISTICS, 4) + bytes(4)
    capture = open_capture(with_bytes(path, short + data[at + 9 + data[at + 1] :]))
    assert any("a record is shorter than its fields" in note for note in capture.damage)
    assert list(messages(capture)) == held


def header_end(data: bytes) -> int:
    """Where the header ends, which is the first record."""
    return int(8 + 9 + struct.unpack_from("<Q", data, 9)[0])


def without_table(data: bytes) -> bytes:
    """Zeros from the header to the second chunk, and no summary."""
    second, header = chunk_offsets(data)[1], header_end(data)
    return data[:header] + bytes(second - header) + data[second:-600]


def without_checksum(data: bytes) -> bytes:
    at = chunk_offsets(data)[1] + 9 + 24
    return data[:at] + bytes(4) + data[at + 4 :]


# What is done to the file, and the numbers of the messages that are left.
LOSSES: dict[str, tuple[Callable[[bytes], bytes], range]] = {
    "the channel table": (without_table, range(FLUSH_EVERY, 24)),
    "all before the second chunk": (
        lambda data: data[:8] + data[chunk_offsets(data)[1] :],
        range(FLUSH_EVERY, 24),
    ),
    "all behind the header": (lambda data: data[: header_end(data)], range(0)),
    "the start that the metadata tell": (
        lambda data: data.replace(str(START).encode(), b"1690000000000000000", 1),
        range(24),
    ),
    "a chunk's checksum": (without_checksum, range(20)),
}


@pytest.mark.parametrize("lost", LOSSES)
def test_what_is_lost_of_our_own_file_changes_neither_times_nor_topics(
    small: Path, tmp_path: Path, lost: str
) -> None:
    change, left = LOSSES[lost]
    held = all_of(small)
    capture = open_capture(with_bytes(tmp_path / "l.mcap", change(small.read_bytes())))
    read = list(messages(capture))
    assert capture.contents.channels == {
        topic.channel: (topic.name, topic.encoding) for topic in TOPICS
    }
    assert len(read) == len(left)
    assert all(message in held for message in read)
    assert capture.start == (START if left else 0)


Fill = Callable[[Writer], Any]


def foreign(path: Path, fill: Fill, **options: Any) -> Path:
    with path.open("wb") as file:
        writer: Any = Writer(file, **options)
        writer.start("", "someone else 2.0")
        fill(writer)
        writer.finish()
    return path


def raw_topics(writer: Writer) -> tuple[int, int]:
    writer.register_channel("/camera", "cdr", 0)  # so that the ids differ from ours
    device = writer.register_channel("/device/raw", "application/octet-stream", 0)
    return writer.register_channel("/host/raw", "", 0), device


def two_taps(writer: Writer) -> None:
    host, device = raw_topics(writer)
    line = writer.register_channel("/line", "json", 0)
    for n in range(50):
        writer.add_message(host, 1000 + 10 * n, b"h%d" % n, 0)
    for n in range(50):
        writer.add_message(device, 1005 + 10 * n, b"d%d" % n, 0)
    writer.add_message(line, 1001, b'{"t":77,"event":"break","more":1}', 0)
    for bad in (b"{", b"[" * 5000, b'{"t":1}', b'{"t":1,"event":"\xff\xff"}', b"", b"1e999"):
        writer.add_message(line, 1002, bad, 0)


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.ZSTD, "enable_crcs": False},
        {"compression": CompressionType.LZ4, "chunk_size": 300, "enable_data_crcs": True},
    ],
    ids=str,
)
def test_foreign_writers_are_read_by_time(tmp_path: Path, options: dict[str, Any]) -> None:
    capture = open_capture(foreign(tmp_path / "f.mcap", two_taps, **options))
    events = list(capture)
    assert capture.start == 1000
    assert not capture.unfinished
    assert capture.damage == ()
    assert events.pop(1) == Line(1, "break")
    assert events == [
        Chunk(
            10 * (n // 2) + 5 * (n % 2), ("host", "device")[n % 2], b"%c%d" % (b"hd"[n % 2], n // 2)
        )
        for n in range(100)
    ]
    assert len(list(messages(capture))) == 107


def test_the_metadata_start_counts_in_a_foreign_file(tmp_path: Path) -> None:
    def fill(writer: Writer, start: str) -> None:
        writer.add_metadata("bilprov", {"start": start})
        writer.add_message(raw_topics(writer)[0], 1000, b"x", 0)

    for start, t in (("900", 100), ("nine", 0), ("-5", 0), ("٣", 0), ("9" * 5000, 0)):
        path = foreign(tmp_path / "f.mcap", partial(fill, start=start))
        assert list(open_capture(path)) == [Chunk(t, "host", b"x")]


def test_other_topics_alone_are_refused_and_shown_harmless(tmp_path: Path) -> None:
    def fill(writer: Writer) -> None:
        writer.register_channel("/b\x1b[31m\u202e", "json", 0)
        writer.add_message(writer.register_channel("/a" * 300, "json", 0), 1, b"{}", 0)

    with pytest.raises(CaptureError) as refused:
        open_capture(foreign(tmp_path / "f.mcap", fill))
    sentence = str(refused.value)
    assert "bilprov needs /host/raw or /device/raw" in sentence
    assert sentence.isprintable()
    assert len(sentence) < 500


def test_channels_without_messages_are_a_capture(tmp_path: Path) -> None:
    capture = open_capture(foreign(tmp_path / "f.mcap", raw_topics, use_chunking=False))
    assert (list(capture), capture.damage, capture.start) == ([], (), 0)
    assert capture.contents.last == 0


def packed_chunk(packed: bytes, declared: int, crc: int = 1) -> bytes:
    """A chunk record of these bytes, which declares the size and checksum of what was packed."""
    front = struct.pack("<QQQII", 0, 0, declared, crc, 4) + b"zstd"
    body = front + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", Opcode.CHUNK, len(body)) + body


@pytest.mark.parametrize("declared", [100, records.CHUNK_BYTES, records.CHUNK_BYTES + 1, 1 << 60])
def test_a_zstd_bomb_is_left_out_without_being_unpacked(
    small: Path, tmp_path: Path, declared: int
) -> None:
    packer = zstandard.ZstdCompressor(level=3).compressobj()
    packed = b"".join([packer.compress(bytes(1 << 20)) for _ in range(200)] + [packer.flush()])
    whole = small.read_bytes()
    last = chunk_offsets(whole)[-1]
    data = whole[:last] + packed_chunk(packed, declared) + whole[last:]
    capture = open_capture(with_bytes(tmp_path / "bomb.mcap", data))
    assert [m.sequence for m in messages(capture)] == list(range(24))
    assert len(capture.damage) == 1


def test_millions_of_false_chunks_do_not_hold_the_reader_up(tmp_path: Path) -> None:
    size = 3_000_000
    front = struct.pack("<QQQI", 0, 0, 1000, 1) + bytes(4)
    at = 17
    parts = [b"\x89MCAP0\r\n", b"\x06" + b"\xff" * 8]
    while at < size - 2_000_000:
        body = size - at - 9
        parts.append(struct.pack("<BQ", 6, body) + front + struct.pack("<Q", body - len(front) - 8))
        at += len(parts[-1])
    parts.append(bytes(size - at))
    path = with_bytes(tmp_path / "h.mcap", b"".join(parts))
    with pytest.raises(CaptureError, match="no topics"):
        open_capture(path)
    with path.open("rb") as file:
        source = RecordFile(file, size)
        assert source.next_chunk(8) is None
        assert source._patience <= 0


def test_limits_of_a_foreign_file_hold(tmp_path: Path) -> None:
    def fill(writer: Writer) -> None:
        host, _ = raw_topics(writer)
        for n in range(100):
            writer.register_channel(f"/more/{n}", "json", 0)
        writer.add_message(host, 1, b"a", 0)
        writer.add_message(host, 2, bytes(records.MESSAGE_BYTES + 1), 0)
        writer.add_message(host, 3, bytes(records.MESSAGE_BYTES), 0)

    for chunked in (True, False):
        path = foreign(tmp_path / "f.mcap", fill, use_chunking=chunked, chunk_size=1 << 20)
        capture = open_capture(path)
        assert [type(event) for event in capture] == [Chunk, Line, Chunk]
        assert len(capture.damage) == 2
        assert len(capture.contents.channels) == records.CHANNELS


def test_metadata_of_more_strings_than_allowed_are_left_out(tmp_path: Path) -> None:
    def fill(writer: Writer) -> None:
        writer.add_metadata("many", {str(n): "" for n in range(records.STRINGS)})
        writer.add_message(raw_topics(writer)[0], 1, b"a", 0)

    capture = open_capture(foreign(tmp_path / "f.mcap", fill))
    assert [event.data for event in capture if isinstance(event, Chunk)] == [b"a"]
    assert "more than the 8192 strings allowed" in capture.damage[0]


def test_a_chunk_above_the_limit_is_left_out_and_what_follows_is_read(tmp_path: Path) -> None:
    def fill(writer: Writer) -> None:
        host, _ = raw_topics(writer)
        for n in range(300):
            writer.add_message(host, n, bytes(60_000), 0)
        writer.add_message(host, 300, b"after", 0)

    path = foreign(tmp_path / "f.mcap", fill, chunk_size=records.CHUNK_BYTES + 1000)
    capture = open_capture(path)
    kept = [event for event in capture if isinstance(event, Chunk)]
    assert len(capture.damage) == 1
    assert "allowed are 16777216: left out" in capture.damage[0]
    assert kept[-1] == Chunk(300 - capture.start, "host", b"after")
    assert [event.event for event in capture if isinstance(event, Line)] == ["gap"]


def test_a_window_too_small_for_the_disorder_is_said(tmp_path: Path) -> None:
    def fill(writer: Writer) -> None:
        host, device = raw_topics(writer)
        for n in range(150_000):
            writer.add_message(host, n + 10, b"x", 0)
        writer.add_message(device, 1, b"y", 0)

    capture = open_capture(foreign(tmp_path / "f.mcap", fill))
    assert capture.start == 1
    assert len(list(capture)) == 150_001
    assert capture.damage == ("1 messages stand too far out of time order to be put right",)


def test_what_is_lost_between_chunks_out_of_order_stays_between_them(tmp_path: Path) -> None:
    def fill(writer: Writer) -> None:
        host, _ = raw_topics(writer)
        for t in (20, 10, 7, 98, 2, 5, 4, 3):  # the channels and one, else two, fill a chunk
            writer.add_message(host, t, bytes(300), 0)

    path = foreign(tmp_path / "f.mcap", fill, chunk_size=400)
    data = bytearray(path.read_bytes())
    data[chunk_offsets(bytes(data))[1] + 60] ^= 0xFF
    capture = open_capture(with_bytes(path, bytes(data)))
    kept = [e.t + capture.start if isinstance(e, Chunk) else e.event for e in capture]
    assert kept == [20, "gap", 2, 3, 4, 5, 98]
    assert (capture.contents.first, capture.contents.last) == (2, 98)


def test_a_file_that_changes_while_it_is_read_is_an_error_of_ours(tmp_path: Path) -> None:
    path, much = tmp_path / "a.mcap", random.Random(1).randbytes(1 << 16)
    with CaptureWriter(path, start_wall=START, metadata={}, version="1") as writer:
        for t in range(4):  # more than is read ahead
            writer.chunk(Chunk(t, "host", much))
            writer.flush()
    events = messages(open_capture(path))
    next(events)
    path.write_bytes(path.read_bytes()[: 2 * len(much)])
    with pytest.raises(CaptureError, match="changed while it was read"):
        list(events)


# -- bounded work ----------------------------------------------------------------------------------


def whole_chunk(content: bytes) -> bytes:
    packed = zstandard.ZstdCompressor().compress(content)
    return packed_chunk(packed, len(content), zlib.crc32(content))


def test_a_chunk_of_empty_records_is_left_out_and_what_follows_is_read(
    small: Path, tmp_path: Path
) -> None:
    whole = small.read_bytes()
    last = chunk_offsets(whole)[-1]
    empty = whole_chunk(struct.pack("<BQ", 0x80, 0) * (records.DESCRIPTIONS + 1))

    capture = open_capture(with_bytes(tmp_path / "e.mcap", whole[:last] + empty + whole[last:]))

    assert [m.sequence for m in messages(capture)] == list(range(24))
    assert "more than 4096 records that are not messages" in capture.damage[0]


@pytest.mark.parametrize("overwritten", [1, 8, 200, -1, -63])
def test_the_first_bytes_may_be_damaged(small: Path, tmp_path: Path, overwritten: int) -> None:
    """So many are zeros, or a bit of the magic is flipped."""
    data, bit = bytearray(small.read_bytes()), max(0, -overwritten)
    if overwritten > 0:
        data[:overwritten] = bytes(overwritten)
    else:
        data[bit // 8] ^= 1 << bit % 8

    capture = open_capture(with_bytes(tmp_path / "m.mcap", bytes(data)))

    assert [m.sequence for m in messages(capture)] == list(range(24))
    assert capture.damage[0].startswith("the first bytes are damaged (")
    assert capture.start == START


@pytest.mark.parametrize("at", [1, 3, 6])
def test_a_chunk_that_stands_twice_is_read_once(small: Path, tmp_path: Path, at: int) -> None:
    whole = small.read_bytes()
    places = [*chunk_offsets(whole), struct.unpack_from("<Q", whole, len(whole) - 28)[0] - 13]
    copied = whole[places[0] : places[1]]
    data = whole[: places[at]] + copied + whole[places[at] :]

    capture = open_capture(with_bytes(tmp_path / "t.mcap", data))

    assert [m.sequence for m in messages(capture)] == list(range(24))
    assert not [event for event in capture if isinstance(event, Line) and event.event == "gap"]
    assert capture.damage == ("28 messages are there, the file's statistics count 24",)


def test_a_file_that_unpacks_to_far_more_than_its_size_is_read_up_to_a_limit(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recovery, "UNPACKED_SHARE", 100)
    whole = small.read_bytes()
    foreign = whole[: chunk_offsets(whole)[0]].replace(b"bilprov 1", b"nothing 1")
    message = struct.pack("<BQHIQQ", Opcode.MESSAGE, 22 + 60_000, 1, 0, START, START)
    large = whole_chunk((message + bytes(60_000)) * 200)
    path = with_bytes(tmp_path / "u.mcap", foreign + large * 5)

    capture = open_capture(path)

    assert "unpacks to more than 32 MiB and 100 x its size" in capture.damage[0]
    room = recovery.UNPACKED_FREE + recovery.UNPACKED_SHARE * path.stat().st_size
    assert 0 < sum(capture.contents.sizes.values()) <= room


def test_a_large_message_index_costs_no_more_memory_than_its_bytes() -> None:
    entries = bytes(1 << 20)
    content = struct.pack("<HI", 1, len(entries)) + entries

    tracemalloc.start()
    parsed(Opcode.MESSAGE_INDEX, content, own=True)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert most < 4 * len(content)
    with pytest.raises(Damaged, match="half an entry"):
        parsed(Opcode.MESSAGE_INDEX, struct.pack("<HI", 1, 24) + bytes(24), own=False)


def test_statistics_of_more_channels_than_there_can_be_are_damage() -> None:
    counts = bytes(10 * (1 << 16) + 10)
    with pytest.raises(Damaged, match="more channels than there can be"):
        parsed(Opcode.STATISTICS, bytes(42) + struct.pack("<I", len(counts)) + counts, own=False)
