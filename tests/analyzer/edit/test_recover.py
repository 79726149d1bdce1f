"""`bilprov capture repair` and `check`: what is whole of a damaged capture, what is lost."""

from __future__ import annotations

from pathlib import Path

import pytest

from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk, Line
from bilprov.captures.writer import CaptureWriter
from tests.support.commands import command

pytestmark = pytest.mark.waits

START = 1_790_000_000_000_000_000
SECOND = 1_000_000_000


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    """A finished capture of 60 instructions and answers in as many chunks, one a second."""
    path = tmp_path / "whole.mcap"
    with CaptureWriter(path, start_wall=START, metadata={}, version="1") as capture:
        for second in range(60):
            capture.chunk(Chunk(second * SECOND, "host", b"\x20"))
            capture.chunk(Chunk(second * SECOND + 1, "device", b"\x00"))
            capture.flush()
    return path


def damaged(whole: Path, at: float, size: int, end: float = 1.0) -> Path:
    data = bytearray(whole.read_bytes())
    place = int(len(data) * at)
    data[place : place + size] = bytes(size)
    path = whole.with_name("broken.mcap")
    path.write_bytes(data[: int(len(data) * end)])
    return path


def bytes_of(path: Path) -> list[tuple[int, bytes]]:
    return [(event.t, event.data) for event in open_capture(path) if isinstance(event, Chunk)]


def test_all_that_can_be_read_is_in_the_new_file(whole: Path) -> None:
    broken = damaged(whole, 0.3, 600)
    before = broken.read_bytes()
    new = whole.with_name("new.mcap")

    done = command("capture", "repair", str(broken), str(new))

    assert (done.returncode, done.stdout) == (0, b"")
    assert b"of the file could not be read" in done.stderr
    assert bytes_of(new) == bytes_of(broken)
    assert 90 < len(bytes_of(new)) < 120
    assert open_capture(new).damage == ()
    (gap,) = [event for event in open_capture(new) if isinstance(event, Line)]
    assert (gap.event, "messages are lost here" in gap.detail) == ("gap", True)
    assert broken.read_bytes() == before
    assert command("capture", "check", str(new)).returncode == 0
