"""The writer behind the reader: nothing is dropped, nothing hangs, and a broken file is told."""

from __future__ import annotations

import os
import random
import threading
import time
from pathlib import Path

import pytest

from bilprov.captures.background import EVENT_BYTES, QUEUE_BYTES, BackgroundWriter
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Checkpoint, Chunk, Line
from bilprov.captures.writer import CaptureWriter
from tests.support.robots import until

START = 1_790_000_000_000_000_000
PATIENCE = 60.0  # s; what takes longer hangs
READ = 64 * 1024 - EVENT_BYTES  # 256 of these fill the queue
FITS = QUEUE_BYTES // (64 * 1024)


def writer(path: Path) -> BackgroundWriter:
    return BackgroundWriter(CaptureWriter(path, start_wall=START, metadata={}, version="0.1.0"))


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
    with pytest.raises(ValueError, match="is closed"):
        capture.chunk(Chunk(0, "host", b"x"))
    assert list(read) == events
    assert (read.unfinished, read.damage, read.contents.counts["/checkpoint"]) == (False, (), 1)


@pytest.mark.waits
def test_what_waits_is_written_without_another_call(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with writer(path) as capture:
        for t in range(3):
            capture.chunk(Chunk(t, "host", b"a"))
            until(lambda t=t: len(chunks(path)) == t + 1)  # type: ignore[misc]


class Handing:
    """A thread that hands over three times what the queue holds; the file is a pipe."""

    def __init__(self, path: Path) -> None:
        self.capture, self.count = writer(path), 0
        self.pipe = onto_a_pipe(path)
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()
        until(lambda: self.count >= FITS - 1)

    def _run(self) -> None:
        data = random.Random(1).randbytes(READ)
        for n in range(3 * FITS):
            self.capture.chunk(Chunk(n, "host", n.to_bytes(4, "big") + data[4:]))
            self.count += 1
        self.capture.close()

    def join(self) -> None:
        self.thread.join(PATIENCE)
        assert not self.thread.is_alive()
        assert self.count == 3 * FITS


@pytest.mark.waits
def test_a_full_queue_makes_the_reader_wait_and_drops_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    handing = Handing(path)
    time.sleep(0.2)  # in which a reader that does not wait would have handed over all
    held = handing.count
    content = path.read_bytes()
    with os.fdopen(handing.pipe, "rb") as consumer:
        content += consumer.read()
    handing.join()
    assert FITS - 1 <= held < FITS + 10  # the pipe and the chunk under way hold some
    path.write_bytes(content)
    assert [int.from_bytes(chunk.data[:4], "big") for chunk in chunks(path)] == [*range(3 * FITS)]
    assert not open_capture(path).unfinished


@pytest.mark.waits
def test_a_file_that_breaks_while_the_queue_is_full_ends_the_waiting(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    handing = Handing(path)
    os.close(handing.pipe)
    handing.join()
    handing.capture.close()
    assert (
        handing.capture.failure == f"Broken pipe: what was captured until 0.0 s is kept in {path}"
    )


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
    assert [chunk.data for chunk in chunks(path)] == [b"x"]
    assert not open_capture(path).unfinished
