"""`bilprov capture decode`: a new capture holds what the old one does, and all that it means."""

from __future__ import annotations

import gzip
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from bilprov.analyzer.api import read_capture
from bilprov.analyzer.decode.records import HostRecord
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.edit.cut import decoded_metadata, new_capture, write_window
from bilprov.analyzer.output.outputs import Window
from bilprov.analyzer.replay.capture_decoding import opened_at
from bilprov.analyzer.replay.recorder import Recorder, RecordWriter
from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import open_capture, open_quickly
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.codec import all_data, raw_frame
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.captures import about, write_capture
from tests.support.commands import Done, command
from tests.support.messages import messages
from tests.support.recordings import attachments_of
from tests.support.traffic import records_of

pytestmark = pytest.mark.slow  # more than make quick has time for

SAMPLES = ROOT / "captures" / "samples"
START = 1_790_000_000_000_000_000
DECODED = ("/host/instructions", "/device/responses", "/state", "/faults")


def converted(path: Path, *before: str) -> tuple[Path, Done]:
    new = path.with_name("new.mcap")
    done = command(*before, "capture", "decode", str(path), str(new))
    assert done.returncode == 0, done.stderr
    assert done.stdout == b""
    return new, done


def by_topic(path: Path) -> dict[str, list[tuple[int, object]]]:
    """The times and values of the messages, by topic."""
    found: dict[str, list[tuple[int, object]]] = {topic.name: [] for topic in topics.TOPICS}
    for message in messages(open_capture(path)):
        found.setdefault(message.topic, []).append((message.t, message.value))
    return found


def recorded(path: Path) -> dict[str, Any]:
    """The messages by topic, but for checkpoints, which an older kit did not make."""
    return {topic: held for topic, held in by_topic(path).items() if topic != "/checkpoint"}


def heavy(protocol: Protocol, path: Path, frames: int, decoded: bool = True) -> tuple[Path, Path]:
    """A live recording in which the decoded topics stop, and one in which they do not."""
    whole = path.with_name("whole.mcap")
    kinds = [
        raw_frame(protocol, spec.id, spec.length, data)
        for spec in protocol.instructions
        for data in list(all_data(spec))[:3]
    ]
    ok = bytes([protocol.responses[0].code])
    session = Session(protocol, timeout=50 * MS, skew=0)
    with (
        Recorder(path, START, about(protocol)) as live,
        RecordWriter(whole, START, about(protocol)) as run,
    ):
        for n in range(frames // 50):
            t = n * 10 * MS
            sent = b"".join(kinds[(n + k) % len(kinds)] for k in range(50))
            for event in (Chunk(t, "host", sent), Chunk(t + MS, "device", ok * (49 + n % 3))):
                live.events([event])
                run.event(event)
                records = session.feed(event) if decoded else []
                count = sum(isinstance(record, HostRecord) for record in records)
                live.decoded(count, event.t, lambda records=records: records)  # type: ignore[misc]
                for record in records:
                    run.record(record)
    return path, whole


@pytest.mark.parametrize("sample", ["examples.mcap", "older/conform.mcap.gz"])
def test_a_sample_has_the_topics_that_it_had(sample: str, tmp_path: Path) -> None:
    content = (SAMPLES / sample).read_bytes()
    path = tmp_path / "old.mcap"
    path.write_bytes(gzip.decompress(content) if sample.endswith(".gz") else content)
    new, done = converted(path)
    assert recorded(new) == recorded(path)
    assert open_capture(new).metadata == open_capture(path).metadata
    assert attachments_of(new) == attachments_of(path)
    assert (open_capture(new).damage, open_capture(new).unfinished) == ((), False)
    assert done.stderr.decode() == f"{path} is in {new}, with everything decoded from it\n"
    if "conform" in sample:
        assert command("recheck", str(new)).stdout.startswith(b"the same: 5 cases, verdict pass")


def test_raw_bytes_alone_become_a_full_capture(tmp_path: Path) -> None:
    raw = tmp_path / "raw.mcap"
    sample = open_capture(SAMPLES / "examples.mcap")
    said = {key: text for key, text in sample.metadata.items() if key != topics.START_KEY}
    write_capture(raw, sample.events(), said, sample.start)
    assert not by_topic(raw)["/host/instructions"]
    new, _ = converted(raw)
    assert recorded(new) == recorded(SAMPLES / "examples.mcap")


def test_topics_that_stopped_while_recording_are_complete_afterwards(
    protocol: Protocol, tmp_path: Path
) -> None:
    live, whole = heavy(protocol, tmp_path / "live.mcap", 6_000)
    new, _ = converted(live)
    was, full, now = by_topic(live), by_topic(whole), by_topic(new)
    assert 0 < len(was["/host/instructions"]) < len(full["/host/instructions"]) == 6_000
    assert {topic: now[topic] for topic in DECODED} == {topic: full[topic] for topic in DECODED}
    for topic in ("/host/raw", "/device/raw", "/line"):
        assert now[topic] == was[topic]


@pytest.fixture(scope="module")
def once(protocol: Protocol, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A live recording of 20,000 frames, made once."""
    live, _ = heavy(protocol, tmp_path_factory.mktemp("once") / "live.mcap", 20_000)
    return live


@pytest.fixture
def live(once: Path, tmp_path: Path) -> Path:
    """A copy of that recording."""
    return Path(shutil.copy(once, tmp_path))


def test_the_new_file_has_checkpoints_to_go_on_from(protocol: Protocol, live: Path) -> None:
    new, _ = converted(live)
    every = list(read_capture(new, protocol))

    for start in (1_200, 2_500, 3_900):
        opened = opened_at(open_quickly(new), protocol, start * MS)
        assert opened.decoder.saved() != StreamDecoder(protocol).saved()
        there = records_of(
            opened.decoder.feed(list(opened.capture.events(opened.after))) + opened.decoder.finish()
        )
        assert there == every[-len(there) :]


def test_a_foreign_capture_is_taken_without_its_other_topics(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(library="other")
        names = (topics.DEVICE_RAW, "/camera\x1b[2J", topics.HOST_RAW)
        device, camera, host = (writer.register_channel(name, "x", 0) for name in names)
        writer.add_message(device, START + 5, b"\0", 0)
        writer.add_message(host, START, b"\x81\x05", 0)
        writer.add_message(camera, START + 1, b"picture", 0)
        writer.finish()
    new, done = converted(path)
    assert b"left out, since they are not bilprov's topics: /camera\\x1b[2J" in done.stderr
    assert list(open_capture(new).events()) == [
        Chunk(0, "host", b"\x81\x05"),
        Chunk(5, "device", b"\0"),
    ]
    found = by_topic(new)
    assert [len(found[topic]) for topic in DECODED[:2]] == [1, 1]


def test_a_capture_that_changes_while_it_is_read_leaves_no_new_one(
    protocol: Protocol, live: Path, tmp_path: Path
) -> None:
    capture = open_capture(live)
    seen = 0

    def progress(size: int) -> None:
        nonlocal seen
        seen += 1
        if seen == 1:
            os.truncate(live, live.stat().st_size // 4)

    about = decoded_metadata(capture, protocol)
    opened = opened_at(capture, protocol, 0)
    with (
        pytest.raises(CaptureError, match="changed while it was read"),
        new_capture(
            tmp_path / "new.mcap", [capture], about, protocol, progress, force=False
        ) as new,
    ):
        write_window(opened, Window(), new, decoded=True)
    assert not list(tmp_path.glob("*new*"))
