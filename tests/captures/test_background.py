"""The writer behind the reader: nothing is dropped, nothing hangs, and a broken file is told."""

from __future__ import annotations

import os
import random
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from bilprov.captures.background import EVENT_BYTES, QUEUE_BYTES, BackgroundWriter
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Checkpoint, Chunk, Line
from bilprov.captures.writer import CaptureWriter

START = 1_790_000_000_000_000_000
PATIENCE = 60.0  # s; what takes longer hangs
READ = 64 * 1024 - EVENT_BYTES  # 256 of these fill the queue
FITS = QUEUE_BYTES // (64 * 1024)


def writer(path: Path) -> BackgroundWriter:
    return BackgroundWriter(CaptureWriter(path, start_wall=START, metadata={}, version="0.1.0"))


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def chunks(path: Path) -> list[Chunk]:
    return [event for event in open_capture(path) if isinstance(event, Chunk)]


def onto_a_pipe(path: Path) -> int:
    """Put a pipe in the place of the open capture file; returns the end that is read."""
    reader, end = os.pipe()
    (number,) = (
        int(entry.name)
        for entry in Path("/proc/self/fd").iterdir()
        if entry.is_symlink() and os.path.realpath(entry) == str(path)
    )
    os.dup2(end, number)
    os.close(end)
    return reader


def test_what_is_handed_over_comes_back_in_order(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    events: list[Chunk | Line] = [
        Line(t, "modem") if t % 7 == 3 else Chunk(t, "device" if t % 2 else "host", b"%d" % t)
        for t in range(5_000)
    ]
    with writer(path) as capture:
        assert capture.path == path
        for event in events:
            if isinstance(event, Chunk):
                capture.chunk(event)
            else:
                capture.write(event, event.t)
        capture.write(Checkpoint.of(5_000, "g", "{}"), 5_000)
    read = open_capture(path)
    assert list(read) == events
    assert (read.unfinished, read.damage, read.contents.counts["/checkpoint"]) == (False, (), 1)
    assert capture.waited_ns == 0


@pytest.mark.waits
def test_what_waits_is_written_without_another_call(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with writer(path) as capture:
        for t in range(3):
            capture.chunk(Chunk(t, "host", b"a"))
            until(lambda t=t: len(chunks(path)) == t + 1)  # type: ignore[misc]


@pytest.mark.waits
def test_a_full_queue_makes_the_reader_wait_and_drops_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    handed = 0
    data = random.Random(1).randbytes(READ)
    capture = writer(path)
    pipe = onto_a_pipe(path)

    def read_a_line() -> None:
        nonlocal handed
        for n in range(3 * FITS):
            capture.chunk(Chunk(n, "host", n.to_bytes(4, "big") + data[4:]))
            handed += 1
        capture.close()

    reader = threading.Thread(target=read_a_line, daemon=True)
    reader.start()
    until(lambda: handed >= FITS - 1)
    time.sleep(0.2)  # in which a reader that does not wait would have handed over all
    held = handed
    content = path.read_bytes()
    with os.fdopen(pipe, "rb") as consumer:
        content += consumer.read()
    reader.join(PATIENCE)
    assert not reader.is_alive()
    assert FITS - 1 <= held < FITS + 10  # the pipe and the chunk under way hold some
    assert capture.waited_ns > 0
    path.write_bytes(content)
    assert [int.from_bytes(chunk.data[:4], "big") for chunk in chunks(path)] == [*range(3 * FITS)]
    assert not open_capture(path).unfinished


@pytest.mark.waits
def test_a_file_that_breaks_while_the_queue_is_full_ends_the_waiting(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    capture = writer(path)
    pipe = onto_a_pipe(path)
    data = random.Random(1).randbytes(READ)
    handed = 0

    def read_a_line() -> None:
        nonlocal handed
        for n in range(3 * FITS):
            capture.chunk(Chunk(n, "host", data))
            handed += 1

    reader = threading.Thread(target=read_a_line, daemon=True)
    reader.start()
    until(lambda: handed >= FITS)
    os.close(pipe)
    reader.join(PATIENCE)
    assert not reader.is_alive()
    assert handed == 3 * FITS
    assert capture.waited_ns > 0
    capture.close()
    capture.close()
    assert capture.failure == f"Broken pipe: what was captured until 0.0 s is kept in {path}"


@pytest.mark.waits
@pytest.mark.parametrize("waits", [True, False])
def test_a_deleted_file_is_told_while_recording_or_at_the_end(tmp_path: Path, waits: bool) -> None:
    path = tmp_path / "a.mcap"
    capture = writer(path)
    assert capture.failure == ""
    path.unlink()
    capture.chunk(Chunk(0, "host", b"x"))
    if waits:
        until(lambda: bool(capture.failure))
        capture.chunk(Chunk(1, "host", b"x"))
        capture.write(Line(1, "modem"), 1)
    capture.close()
    capture.close()
    assert "was deleted while recording" in capture.failure


def test_wrong_use_is_told_and_the_file_is_finished(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    capture = writer(path)
    capture.chunk(Chunk(0, "host", b"x"))
    capture.chunk(Chunk(-START - 1, "host", b"y"))
    with pytest.raises(ValueError, match="log time is"):
        capture.close()
    capture.close()
    assert [chunk.data for chunk in chunks(path)] == [b"x"]
    assert not open_capture(path).unfinished


def test_after_closing_nothing_is_taken(tmp_path: Path) -> None:
    capture = writer(tmp_path / "a.mcap")
    capture.close()
    capture.close()
    with pytest.raises(ValueError, match="is closed"):
        capture.chunk(Chunk(0, "host", b"x"))
    assert not open_capture(tmp_path / "a.mcap").unfinished
