"""Recorded runs: any changed byte is detected, and other tools can read the file."""

from __future__ import annotations

import gzip
import os
import re
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import open_capture, open_evidence
from bilprov.captures.storage.records import ATTACHMENT_BYTES
from bilprov.captures.writer import CaptureWriter
from bilprov.conformance.recheck import recheck
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.messages import messages
from tests.support.recordings import WALL, attachments_of, recorded

TELLS = re.compile("checksum")
SAMPLES = ROOT / "captures" / "samples"
SHARDS = 2
ENDS = 2048


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory, protocol: Protocol) -> Path:
    """A recording of a few cases."""
    path = tmp_path_factory.mktemp("small") / "run.mcap"
    recorded(path, protocol, "unused-id/9/0")
    return path


def places(size: int, stride: int) -> list[int]:
    """Every place near the ends, where the file's own records lie, and many between."""
    ends = {*range(min(size, ENDS)), *range(max(0, size - ENDS), size)}
    return sorted(ends | {*range(0, size, stride)})


@pytest.mark.slow
@pytest.mark.parametrize("shard", range(SHARDS))
def test_any_flipped_bit_is_told_by_a_checksum(
    small: Path, tmp_path: Path, shard: int, pytestconfig: pytest.Config
) -> None:
    every = pytestconfig.getoption("--whole")
    chosen = places(small.stat().st_size, 17 if every else 397)[:: 1 if every else 13]
    content = small.read_bytes()
    path = tmp_path / "flipped.mcap"
    path.write_bytes(content)
    assert recheck(str(path)).exit == 0
    unnoticed, untold = [], []
    with path.open("r+b", buffering=0) as file:
        for at in chosen[shard::SHARDS]:
            os.pwrite(file.fileno(), bytes([content[at] ^ 1 << at % 8]), at)
            try:
                unnoticed.append((at, recheck(str(path)).exit))
            except CaptureError as error:
                if not TELLS.search(str(error)) or "\n" in str(error):
                    untold.append((at, str(error)))
            os.pwrite(file.fileno(), content[at : at + 1], at)

    assert (unnoticed, untold) == ([], [])


@pytest.mark.slow
def test_a_byte_left_out_or_put_in_is_told(small: Path, tmp_path: Path) -> None:
    content = small.read_bytes()
    path = tmp_path / "changed.mcap"
    for at in [*range(0, len(content), 3989), len(content)]:
        left_out, put_in = content[:at] + content[at + 1 :], content[:at] + b"\0" + content[at:]
        for changed in {left_out, put_in} - {content}:
            path.write_bytes(changed)
            with pytest.raises(CaptureError, match=TELLS):
                recheck(str(path))


def test_what_the_run_rests_on_stands_before_its_first_byte(small: Path) -> None:
    with small.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    attached = {index.name: index.offset for index in summary.attachment_indexes}
    with_host_bytes = [
        index.chunk_start_offset
        for index in summary.chunk_indexes
        if topics.TOPICS[0].channel in index.message_index_offsets
    ]

    assert attached["run.json"] < min(with_host_bytes)
    assert max(with_host_bytes) < attached["verdict.json"]


def test_sniffed_captures_are_evidence_too(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with CaptureWriter(path, start_wall=WALL, metadata={}, version="0.1.0") as writer:
        writer.attach("note.txt", "text/plain", b"hello", 5)

    evidence = open_evidence(path, ("note.txt", "none.txt"))

    assert not evidence.capture.unfinished
    assert evidence.attachments == {"note.txt": b"hello"}
    content = path.read_bytes()
    path.write_bytes(content[:-24] + b"\1" + content[-23:])  # its summary begins behind the end
    with pytest.raises(CaptureError, match=TELLS):
        open_evidence(path, ())


def test_an_attachment_over_the_limit_is_left_out_and_that_is_said(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with CaptureWriter(path, start_wall=WALL, metadata={}, version="0.1.0") as writer:
        writer.attach("big", "", bytes(ATTACHMENT_BYTES + 1), 5)

    (message,) = messages(open_capture(path))
    assert message.topic == "/faults"
    assert f"big: {ATTACHMENT_BYTES + 1} bytes" in str(message.value)
    assert attachments_of(path) == {}


def test_an_attachment_with_a_wrong_checksum_is_damage_also_in_an_unfinished_file(
    small: Path, tmp_path: Path
) -> None:
    content = bytearray(small.read_bytes())
    content[content.index(b"circumstances")] ^= 1
    path = tmp_path / "cut.mcap"
    path.write_bytes(content[: content.index(b"verdict.json")])  # never finished

    assert "checksum (CRC) of an attachment" in str(open_capture(path).damage)
    with pytest.raises(CaptureError, match="checksum"):
        recheck(str(path))


def test_an_attachment_that_states_an_endless_length_is_damage(small: Path, tmp_path: Path) -> None:
    content = bytearray(small.read_bytes())
    media_type = b"application/json"
    length = content.index(media_type) + len(media_type)
    content[length + 7] ^= 0x80  # the highest bit of 64
    path = tmp_path / "endless.mcap"
    path.write_bytes(content)

    assert "a record is shorter than its fields" in str(open_capture(path).damage)


def test_a_file_of_another_program_is_no_evidence(tmp_path: Path) -> None:
    path = tmp_path / "theirs.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("", "another program")
        channel = writer.register_channel(topics.HOST_RAW, topics.RAW_ENCODING, 0)
        writer.add_message(channel, WALL, b"\x20", WALL, 0)
        writer.add_attachment(WALL, WALL, "run.json", "application/json", b"content")
        writer.finish()

    for content in (path.read_bytes(), path.read_bytes()[:-300]):  # the second never finished
        path.write_bytes(content)
        assert open_capture(path).damage == ()
        with pytest.raises(CaptureError, match=r"theirs\.mcap was saved by another program"):
            open_evidence(path, ())


def test_a_recording_with_a_seal_of_an_older_kit_is_still_evidence(tmp_path: Path) -> None:
    path = tmp_path / "older.mcap"
    content = gzip.decompress((SAMPLES / "older" / "conform.mcap.gz").read_bytes())
    path.write_bytes(content)
    assert list(open_evidence(path, ("run.json",)).attachments) == ["run.json"]

    place = content.index(b"Stops the robot")
    path.write_bytes(content[:place] + b"s" + content[place + 1 :])
    with pytest.raises(CaptureError, match=TELLS):
        open_evidence(path, ())
