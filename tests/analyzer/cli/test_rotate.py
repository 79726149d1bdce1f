"""`bilprov sniff --rotate --keep` on real ptys, and every command over what it has recorded."""

from __future__ import annotations

import random
import signal
import time
from pathlib import Path

import pytest

from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.output.outputs import Output, Shown
from bilprov.analyzer.pipeline import Pipeline
from bilprov.analyzer.replay.recorder import Recorder, Rotation
from bilprov.analyzer.transport.port import open_port
from bilprov.captures.parts import part_path, part_paths
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import MS, Chunk
from bilprov.captures.writer import CaptureWriter
from bilprov.spec.protocol import Protocol
from tests.analyzer.cli.sniffing import Sniffing, kept, sniffing, write
from tests.support import commands
from tests.support.attaching import Talk, attached
from tests.support.captures import about
from tests.support.robots import RecordingRobot, served_here, until
from tests.support.wires import json_lines

START = 1_790_000_000_000_000_000
NAME = "drive.mcap"
SECONDS = 3  # of traffic in the recordings that commands read


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / NAME


def talk_until(part: Path, one: Sniffing, draw: random.Random, pause: float = 0.0) -> bytes:
    """Say random speeds until a part of the recording is there; returns all that was said."""
    said = b""
    while not part.exists():
        data = b"".join(bytes([0x11, draw.randrange(256)]) for _ in range(20))
        write(one.host, data)
        one.lines(20)  # so that nothing overruns the pty
        said += data
        time.sleep(pause)
    return said


@pytest.mark.waits
def test_a_log_goes_on_from_part_to_part_and_the_oldest_go(path: Path) -> None:
    foreign = path.with_name("drive.1.mcap")
    foreign.write_bytes(b"precious")
    with sniffing(path, "--rotate", "1s", "--keep", "2", taps=1) as one:
        said = talk_until(part_path(path, 4), one, random.Random(1), 0.05)
        code, out, err = one.command.end()
    parts = part_paths(path)
    first, last = min(parts), max(parts)
    assert (code, last - first, first >= 3, out) == (0, 1, True, b"")
    (totals,) = err.decode().splitlines()
    names = f"{parts[first]} to {parts[last]}"
    assert totals == f"{len(said) // 2:,} instructions, 0 answers, 0 faults in {names}"
    assert said.endswith(kept(path))
    assert b"".join(map(kept, parts.values())) == kept(path)
    assert foreign.read_bytes() == b"precious"
    assert [open_capture(part).unfinished for part in parts.values()] == [False] * 2
    replayed = commands.command("replay", str(path), "--rate", "0", "--format", "jsonl")
    assert replayed.returncode == 0
    assert b"older parts are not there" in replayed.stderr
    shown = [row for row in json_lines(replayed.stdout) if row["kind"] == "instruction"]
    assert len(shown) == len(kept(path)) // 2


@pytest.mark.waits
@pytest.mark.parametrize("deleted", [False, True])
def test_a_fault_at_a_seam_ends_the_recording_alone_and_leaves_what_was_before(
    path: Path, deleted: bool
) -> None:
    first, second = (part_path(path, number) for number in (1, 2))
    with sniffing(path, "--rotate", "1s", taps=1) as one:
        write(one.host, b"\x11\x01")
        one.lines()
        until(lambda: first.stat().st_size and kept(first) == b"\x11\x01")
        if deleted:
            one.command.wait_for(second)
            second.unlink()
            write(one.host, b"\x11\x02")
        else:
            one.fill_disk()  # at the seam, where nothing is said
        at_once = one.error()
        write(one.host, b"\x11\x03")
        one.row("11 03")
        code, _, err = one.command.end()
    sentence = err.decode().splitlines()[-1]
    cause = "drive.00002.mcap was deleted while" if deleted else "disk full: what was captured"
    assert code == 2
    assert at_once == f"{sentence}; listening goes on, without recording\n"
    assert cause in sentence
    assert kept(path) == b"\x11\x01"


@pytest.mark.waits
def test_a_bridge_hands_on_though_a_part_cannot_be_closed(path: Path, protocol: Protocol) -> None:
    with (
        served_here(RecordingRobot(protocol), pty=True) as (port, _),
        sniffing(path, "--bridge", port, "--rotate", "1s", taps=0) as one,
        open_port(one.error().strip()) as host,
    ):
        one.command.wait_for(part_path(path, 2))
        # With room for the next part, and for all of its end but the last bytes.
        one.fill_disk(part_path(path, 1).stat().st_size - 100)
        host.write(b"\x20")  # a part in which nothing was said is not closed
        at_once = one.error()
        host.write(b"\x20")
        rows = json_lines(one.lines(4))
        code, _, err = one.command.end()
    sentence = err.decode().splitlines()[-1]
    assert [row["hex"] for row in rows] == ["20", "00"] * 2
    assert code == 2
    assert at_once == f"{sentence}; listening goes on, without recording\n"
    assert sentence.startswith("bilprov: disk full: what was captured until ")
    assert not open_capture(part_path(path, 1)).unfinished


@pytest.mark.waits
@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", range(4))
def test_kill_9_leaves_what_was_said_from_its_begin_on(path: Path, seed: int) -> None:
    with sniffing(path, "--rotate", "1s", taps=1) as one:
        said = talk_until(part_path(path, 3), one, random.Random(seed))
        one.command.end(signal.SIGKILL)
    capture = open_capture(path)
    assert (capture.damage, capture.unfinished) == ((), True)
    assert said.startswith(kept(path))
    assert len(kept(path)) > len(said) // 2
    for part in part_paths(path).values():
        done = commands.command("capture", "info", str(part))
        assert (done.returncode, done.stderr) == (0, b"") or not part.stat().st_size


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory, protocol: Protocol) -> tuple[Path, Path]:
    """Two folders with a recording `drive.mcap`: as one file, and in parts."""
    one, several = tmp_path_factory.mktemp("one"), tmp_path_factory.mktemp("several")
    metadata = about(protocol)
    talk = attached(protocol, Talk(faulty=0.1, pause=15 * MS), random.Random(3), 400)
    for folder, rotation in ((one, None), (several, Rotation(age=400 * MS))):
        decoder = StreamDecoder(protocol, timeout=50 * MS, skew=0)
        with Recorder(folder / NAME, START, metadata, rotation) as recorder:
            pipeline = Pipeline(decoder, Shown(Output()), recorder)
            for event in talk.events:
                pipeline.events([event])
            pipeline.finish()
    assert len(part_paths(several / NAME)) > 4
    assert open_capture(one / NAME).contents.last > START + SECONDS * 10**9
    return one, several


READING = [
    "replay drive.mcap --rate 0 --format jsonl",
    "replay drive.mcap --rate 0 --start 1.5 --end 2.5",
    "replay drive.mcap --rate 0 --filter faulty --format csv",
    "stats drive.mcap --json -",
    "export drive.mcap --format pcapng -o OUT",
    "capture cut drive.mcap OUT --filter faulty",
    "capture decode drive.mcap OUT",
    "capture diff ONE drive.mcap",
    "capture join drive.mcap LATER -o OUT",
]


@pytest.mark.sample(8)
@pytest.mark.parametrize("line", READING)
def test_a_command_over_parts_does_what_it_does_over_one_file(
    both: tuple[Path, Path], tmp_path: Path, line: str
) -> None:
    one, _ = both
    later = one.parent / "later.mcap"
    if not later.exists():
        about = {"heard": "device host"}
        with CaptureWriter(later, start_wall=START + 10**12, metadata=about, version="0") as writer:
            writer.chunk(Chunk(0, "host", b"\x11\x05"))
    results = []
    for folder in both:
        out = tmp_path / folder.name / "out"
        out.parent.mkdir()
        places = {"OUT": out, "ONE": one / NAME, "LATER": later}
        words = [str(places.get(word, word)) for word in line.split()]
        done = commands.command(*words, cwd=folder)
        content = out.read_bytes() if out.exists() else b""
        texts = [text.replace(str(out.parent).encode(), b"") for text in (done.stdout, done.stderr)]
        results.append((done.returncode, texts, content))
    assert results[0] == results[1]
    assert results[0][0] == 0, results[0][1]
    assert any(results[0][1]) or content
