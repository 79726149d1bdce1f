"""The spool of a session that nobody asked to log: bounded, kept if asked, and never in the way."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from random import Random

import pytest

from bilprov.analyzer.replay.recorder import PARTS, Spool, session_metadata
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk, Line
from bilprov.captures.topics import CUT_START
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS
from tests.support.robots import until

START = 1_700_000_000_000_000_000


@pytest.fixture
def metadata(protocol: Protocol) -> dict[str, str]:
    return session_metadata(
        protocol, ports={"host": "a"}, line="115200 8N1", timeout=50 * MS, skew=0, heard=["host"]
    )


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def bytes_of(path: Path) -> bytes:
    return b"".join(event.data for event in open_capture(path) if isinstance(event, Chunk))


def test_a_short_session_is_kept_whole_and_the_temporary_files_go(
    tmp_path: Path, own_folder: Path, metadata: dict[str, str]
) -> None:
    kept = tmp_path / "kept.mcap"
    with Spool(START, metadata) as spool:
        spool.events([Line(0, "open"), Chunk(MS, "host", b"\x20\x00")])
        spool.tick(2 * MS)
        spool.finish()
        spool.keep(kept)

    assert bytes_of(kept) == b"\x20\x00"
    assert not open_capture(kept).unfinished
    assert (spool.failure, spool.oldest, spool.bytes) == ("", 0, 2)
    assert list(own_folder.iterdir()) == []


@pytest.mark.waits
def test_the_oldest_goes_and_the_rest_is_kept_in_its_parts(
    tmp_path: Path, own_folder: Path, metadata: dict[str, str]
) -> None:
    kept, random, said = tmp_path / "kept.mcap", Random(1), b""
    part, sent = 32 * 1024, 0
    with Spool(START, metadata, most=PARTS * part) as spool:
        give_up = time.monotonic() + 20
        while not spool.oldest:
            assert time.monotonic() < give_up
            data = random.randbytes(part)
            sent, said = sent + 1, said + data
            spool.events([Chunk(sent * MS, "host", data)])
            spool.checkpoint(sent * MS, lambda: None)
            time.sleep(0.01)
        files = list(next(own_folder.iterdir()).iterdir())
        assert len(files) == PARTS
        assert spool.bytes == len(said)
        spool.finish()
        names = spool.keep(kept)

    assert len(names) == PARTS
    assert not kept.exists()
    capture = open_capture(kept)
    assert (capture.in_parts, capture.number(CUT_START)) == (True, spool.oldest)
    rest = bytes_of(kept)
    assert 0 < len(rest) < len(said)
    assert said.endswith(rest)


def test_a_file_is_never_overwritten_and_the_session_is_not_lost(
    tmp_path: Path, own_folder: Path, metadata: dict[str, str]
) -> None:
    there = tmp_path / "there.mcap"
    there.write_bytes(b"precious")
    with Spool(START, metadata) as spool:
        spool.events([Chunk(MS, "host", b"\x20")])
        spool.finish()
        with pytest.raises(CaptureError, match="the capture is in"):
            spool.keep(there)

    assert there.read_bytes() == b"precious"
    (kept,) = own_folder.rglob("*.mcap")
    assert bytes_of(kept) == b"\x20"


def test_what_cannot_be_kept_whole_leaves_nothing_under_the_name(
    tmp_path: Path, own_folder: Path, metadata: dict[str, str]
) -> None:
    kept = tmp_path / "kept.mcap"
    with Spool(START, metadata, most=PARTS * 1024) as spool:
        for number in (1, 2):
            spool.events([Chunk(number * MS, "host", Random(number).randbytes(5_000))])
            first = next(own_folder.rglob("*.mcap"))
            until(lambda part=first: part.stat().st_size >= 5_000)
            spool.checkpoint(number * MS, lambda: None)
        spool.finish()
        spool.paths[-1].chmod(0)
        spool.paths[-1].rename(spool.paths[-1].with_name("away"))
        spool.paths[-1].symlink_to("nowhere.mcap")
        with pytest.raises(CaptureError, match="the capture is in"):
            spool.keep(kept)

    assert list(tmp_path.glob("kept*")) == []


def test_where_nothing_can_be_written_that_is_said_at_first(
    monkeypatch: pytest.MonkeyPatch, metadata: dict[str, str]
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", "/proc")
    with pytest.raises(CaptureError, match="the session cannot be saved: "):
        Spool(START, metadata)


@pytest.mark.waits
@pytest.mark.parametrize("when", ["while it is written", "when it ends", "when the spool ends"])
def test_a_part_that_cannot_be_written_is_told(
    own_folder: Path, metadata: dict[str, str], when: str
) -> None:
    with Spool(START, metadata, most=PARTS * 1024) as spool:
        give_up = time.monotonic() + 20
        if when == "when it ends":
            spool.events([Chunk(0, "host", Random(1).randbytes(5_000))])
            part = next(own_folder.rglob("*.mcap"))
            until(lambda: part.stat().st_size >= 5_000)
            with part.open("ab") as file:
                file.write(b"from another program")
            spool.checkpoint(MS, lambda: None)
        else:
            next(own_folder.rglob("*.mcap")).open("wb").close()  # another program empties it
            spool.events([Chunk(MS, "host", b"x")])
        if when == "while it is written":
            while not spool.failure:
                assert time.monotonic() < give_up
                spool.tick(2 * MS)
                time.sleep(0.005)
        spool.finish()
        assert spool.failure.startswith("another program made")
