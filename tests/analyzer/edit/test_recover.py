"""`bilprov capture repair` and `check`: what is whole of a damaged capture, what is lost."""

from __future__ import annotations

import json
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


@pytest.mark.parametrize("name", ["new.mcap", "broken.mcap"])
def test_no_file_is_overwritten(whole: Path, name: str) -> None:
    broken = damaged(whole, 0.3, 600)
    there = whole.with_name("new.mcap")
    there.write_bytes(b"mine")

    done = command("capture", "repair", str(broken), str(whole.with_name(name)))

    assert done.returncode == 2
    assert b"Traceback" not in done.stderr
    assert there.read_bytes() == b"mine"


def test_a_check_tells_what_is_lost_and_the_command_that_saves_the_rest(whole: Path) -> None:
    broken = damaged(whole, 0.3, 600)

    done = command("capture", "check", str(broken), "--format", "json")

    told = json.loads(done.stdout)
    assert (done.returncode, told["exit"], told["usable"]) == (2, 2, False)
    found = {one["check"]: one for one in told["findings"]}
    assert "are damaged and left out" in found["damage"]["sentence"]
    losses = [one["sentence"] for one in told["findings"] if one["check"] == "lost"]
    assert losses
    assert all(" s: " in one and "messages are lost here" in one for one in losses)
    assert found["mend"]["command"].split()[:3] == ["bilprov", "capture", "repair"]
    again = command(*found["mend"]["command"].split()[1:])
    assert again.returncode == 0


def test_a_capture_that_was_cut_off_says_where_it_ends(whole: Path) -> None:
    done = command("capture", "check", str(damaged(whole, 0, 0, end=0.5)))

    assert done.returncode == 2
    assert b"ends inside a record" in done.stdout


def test_a_whole_capture_is_well(whole: Path) -> None:
    done = command("capture", "check", str(whole))

    assert done.returncode == 0
    assert b"120 messages over 59.0 s" in done.stdout
