"""Captures opened by their index: they tell what a survey tells, and a lie is never believed."""

from __future__ import annotations

import gzip
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture, open_capture, open_indexed, open_verified
from bilprov.captures.schemas import Checkpoint, Chunk, Line, Look
from bilprov.captures.topics import CarLook
from bilprov.captures.writer import CaptureWriter
from tests.support import ROOT
from tests.support.captures import record_places
from tests.support.messages import messages

START = 1_790_000_000_000_000_000
STEP = 1_000
GRAMMAR = "a" * 64
SAMPLES = ROOT / "captures" / "samples"


def written(path: Path, checkpoints: dict[int, Checkpoint] | None = None) -> Path:
    """A finished capture of 12 chunks with 5 messages each, and a checkpoint after some."""
    marks = checkpoints
    if marks is None:
        marks = {n: Checkpoint.of(n * STEP, GRAMMAR, f'{{"after":{n}}}') for n in range(7, 60, 6)}
    metadata = {"grammar_sha256": GRAMMAR, "heard": "host device"}
    with CaptureWriter(path, start_wall=START, metadata=metadata, version="1") as capture:
        for n in range(60):
            t = n * STEP
            if n % 10 == 3:
                capture.write(Line(t, "modem", "host", f"cts {n}"), t)
            elif n % 10 == 8:
                capture.write(CarLook(t, n % 20 == 8), t)
            else:
                capture.chunk(Chunk(t, "device" if n % 2 else "host", b"%d" % n))
            if n in marks:
                capture.write(marks[n], n * STEP)
            if n % 5 == 4:
                capture.flush()
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return written(tmp_path / "a.mcap")


def opened(path: Path) -> Capture:
    capture = open_indexed(path)
    assert capture is not None
    return capture


def changed_summary(path: Path, change: Callable[[bytearray, int], None]) -> None:
    """Change the summary, which begins at the offset given, and put its checksum right."""
    content = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<Q", content, len(content) - 28)
    change(content, start)
    struct.pack_into("<I", content, len(content) - 12, zlib.crc32(content[start:-12]))
    path.write_bytes(bytes(content))


def entries(content: bytes, start: int, kind: int = 8) -> list[int]:
    """The offsets of the records of a kind in the summary: entries of chunks, or statistics."""
    return [at for at, _ in record_places(content, kind, start)]


def test_it_tells_what_a_survey_tells(path: Path) -> None:
    indexed, surveyed = opened(path), open_capture(path)
    for name in ("path", "start", "metadata", "unfinished", "damage"):
        assert getattr(indexed, name) == getattr(surveyed, name)
    for name in ("library", "counts", "channels", "first", "last", "own", "size"):
        assert getattr(indexed.contents, name) == getattr(surveyed.contents, name)
    assert list(indexed.sights()) == list(surveyed.sights())
    assert list(indexed.events()) == list(indexed) == list(surveyed.events())
    assert list(messages(indexed)) == list(messages(surveyed))


def test_captures_of_older_kits_open_by_their_index_too(tmp_path: Path) -> None:
    older = tmp_path / "older.mcap"
    older.write_bytes(gzip.decompress((SAMPLES / "older" / "conform.mcap.gz").read_bytes()))
    for path in (older, SAMPLES / "examples.mcap"):
        assert list(opened(path).sights()) == list(open_capture(path).sights())
        assert opened(path).checkpoint_before(1 << 62) is None


def test_the_checkpoint_is_the_last_one_strictly_before_the_time(path: Path) -> None:
    capture = opened(path)
    times = [n * STEP for n in range(7, 60, 6)]
    for t in [0, *(at + by for at in times for by in (-1, 0, 1)), 1 << 62]:
        before = [at for at in times if at < t]
        found = capture.checkpoint_before(t, GRAMMAR)
        assert (found.value.t if found else None) == (before[-1] if before else None)


def test_what_follows_a_checkpoint_is_what_stands_behind_it_in_the_file(tmp_path: Path) -> None:
    # By place, not by time: the checkpoint tells an earlier time than the message before it.
    marks = {n: Checkpoint.of(n * STEP, GRAMMAR, str(n)) for n in (7, 9, 10, 31, 59)}
    capture = opened(written(tmp_path / "a.mcap", marks))
    whole = list(capture.sights())
    for n in marks:
        found = capture.checkpoint_before(n * STEP + 1)
        assert found is not None
        assert found.value == marks[n]
        assert list(capture.sights(found)) == whole[n + 1 :]
        rest = [event for event in whole[n + 1 :] if not isinstance(event, Look)]
        assert list(capture.events(found)) == rest


def test_behind_a_checkpoint_with_the_last_number_any_number_may_come(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with CaptureWriter(path, start_wall=START, metadata={}, version="1") as writer:
        writer._sequence = 0xFFFF_FFFF
        writer.write(Checkpoint.of(1, GRAMMAR, "{}"), 1)
        writer._sequence = 5
        writer.chunk(Chunk(2, "host", b"a"))

    found = opened(path).checkpoint_before(2)

    lost = Line(2, "gap", "", "5 messages are lost here, the file is damaged")
    assert list(opened(path).events(found)) == [lost, Chunk(2, "host", b"a")]


def test_nothing_before_the_checkpoint_is_read(path: Path) -> None:
    capture = opened(path)
    found = capture.checkpoint_before(1 << 62, GRAMMAR)
    assert found is not None
    after = list(capture.sights(found))
    content = bytearray(path.read_bytes())
    content[1_000 : found.place.chunk] = bytes(found.place.chunk - 1_000)
    path.write_bytes(bytes(content))
    assert opened(path).checkpoint_before(1 << 62, GRAMMAR) == found
    assert list(opened(path).sights(found)) == after


LIES = {
    "its checksum is wrong": Checkpoint(55 * STEP, GRAMMAR, "{}", 1),
    "it is of another grammar": Checkpoint.of(55 * STEP, "b" * 64, "{}"),
    "its state is not JSON": Checkpoint.of(55 * STEP, GRAMMAR, "{"),
    "its time is not its message's": Checkpoint.of(3 * STEP, GRAMMAR, "{}"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_checkpoint_that_lies_is_passed_over(tmp_path: Path, lie: str) -> None:
    good = Checkpoint.of(20 * STEP, GRAMMAR, "{}")
    capture = opened(written(tmp_path / "a.mcap", {20: good, 55: LIES[lie]}))
    found = capture.checkpoint_before(1 << 62, GRAMMAR)
    assert found is not None
    assert found.value == good
    alone = opened(written(tmp_path / "b.mcap", {55: LIES[lie]}))
    assert alone.checkpoint_before(1 << 62, GRAMMAR) is None


def test_a_damaged_chunk_costs_its_checkpoints_alone(path: Path) -> None:
    capture = opened(path)
    last = capture.checkpoint_before(54 * STEP, GRAMMAR)
    assert last is not None
    content = bytearray(path.read_bytes())
    content[last.place.chunk + 33] ^= 1  # in the checksum
    path.write_bytes(bytes(content))
    found = opened(path).checkpoint_before(54 * STEP, GRAMMAR)
    assert found is not None
    assert 0 < found.value.t < last.value.t
    rest = list(opened(path).sights(found))
    assert [event.event for event in rest if isinstance(event, Line)].count("gap") == 1
    survey = list(open_capture(path).sights())
    assert rest == survey[-len(rest) :]


def set_entry(field: int, value: int, entry: int = -2) -> Callable[[bytearray, int], None]:
    """Set a number (8 bytes) of the entry of the last chunk but one: times, offset, length."""
    return lambda content, start: struct.pack_into(
        "<Q", content, entries(content, start)[entry] + 9 + 8 * field, value
    )


def set_count_of_maps(content: bytearray, start: int) -> None:
    struct.pack_into("<I", content, entries(content, start, 0x0B)[0] + 9 + 42, 1 << 31)


def set_length(content: bytearray, start: int) -> None:
    struct.pack_into("<Q", content, entries(content, start)[-2] + 1, 1 << 40)


def rename_channel(content: bytearray, start: int) -> None:
    at = content.index(b"/checkpoint\x04", start)
    content[at : at + 11] = b"/checkpo1nt"


def other_start(content: bytearray, start: int) -> None:
    at = content.index(str(START).encode(), start)
    content[at : at + 4] = b"9999"


REFUSED: dict[str, Callable[[bytearray, int], None]] = {
    "a chunk after the file": set_entry(2, 1 << 62),
    "a chunk in the summary": set_entry(2, 1 << 16),
    "a chunk before the last one": set_entry(2, 9),
    "a chunk that is too long": set_entry(3, 1 << 40),
    "a last chunk that is too long": set_entry(3, 1 << 40, -1),
    "an entry that ends after the summary": set_length,
    "a map that is too long": set_count_of_maps,
    "another topic": rename_channel,
    "another start": other_start,
}


@pytest.mark.parametrize("lie", REFUSED)
def test_an_index_that_lies_is_not_believed(path: Path, lie: str) -> None:
    changed_summary(path, lambda content, start: None)
    whole = list(opened(path).sights())
    changed_summary(path, REFUSED[lie])
    assert open_indexed(path) is None
    assert list(open_capture(path).sights()) == whole


def unfinished(path: Path) -> None:
    os.truncate(path, path.stat().st_size - 1)


def flipped_in_the_summary(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-500] ^= 1
    path.write_bytes(bytes(content))


def by_another(path: Path, library: str = "bilprovX", **options: bool) -> None:
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="", library=library)
        writer.add_metadata("bilprov", {"start": "5"})
        channel = writer.register_channel(topics.HOST_RAW, topics.RAW_ENCODING, 0)
        writer.add_message(channel, 5, b"x", 5)
        writer.finish()


def without_an_index(path: Path) -> None:
    by_another(path, "bilprov 0", use_statistics=False, repeat_channels=False)


def a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize(
    "make",
    [
        *(unfinished, flipped_in_the_summary, by_another, without_an_index, os.unlink, a_pipe),
        lambda path: path.write_bytes(b""),
    ],
)
def test_any_other_file_is_left_to_the_survey(path: Path, make: Callable[[Path], Any]) -> None:
    make(path)
    assert open_indexed(path) is None
    assert open_indexed(path.parent) is open_indexed(Path("a\0b")) is None


def test_a_file_that_changed_since_it_was_opened_is_an_error_of_ours(path: Path) -> None:
    capture = opened(path)
    os.truncate(path, path.stat().st_size - 1)
    for read in (lambda: list(capture.events()), lambda: capture.checkpoint_before(1 << 62)):
        with pytest.raises(CaptureError, match="changed while it was read"):
            read()
    path.unlink()
    for read in (lambda: list(capture.events()), lambda: capture.checkpoint_before(1 << 62)):
        with pytest.raises(CaptureError, match="does not exist"):
            read()


def test_a_verified_capture_hides_no_damage(path: Path, pytestconfig: pytest.Config) -> None:
    def told(opening: Callable[[Path], Capture]) -> object:
        try:
            return opening(path).damage
        except CaptureError as error:
            return str(error)

    data = path.read_bytes()
    assert open_verified(path).indexed
    for at in range(0, len(data), 17 if pytestconfig.getoption("--whole") else 331):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :])
        assert told(open_verified) == told(open_capture)
