"""`bilprov sniff --rotate --keep` on real ptys, and every command over what it has recorded."""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from bilprov.analyzer.columns.decoder import StreamDecoder
from bilprov.analyzer.output.outputs import NoOutput, Shown
from bilprov.analyzer.output.statistics import Statistics
from bilprov.analyzer.pipeline import Pipeline
from bilprov.analyzer.replay.recorder import Recorder, session_metadata
from bilprov.analyzer.replay.rotation import Rotation
from bilprov.analyzer.transport.pty import PtyPair, open_pty
from bilprov.captures.parts import part_path, part_paths
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import MS, Chunk
from bilprov.captures.writer import CaptureWriter
from bilprov.spec.protocol import Protocol
from tests.support import commands
from tests.support.attaching import Talk, attached
from tests.support.wires import PATIENCE, PtyRobot, Running, json_lines, running, served

START = 1_790_000_000_000_000_000
NAME = "drive.mcap"
SECONDS = 3  # of traffic in the recordings that commands read


def refused(*arguments: str, cwd: Path) -> str:
    done = commands.command(*arguments, cwd=cwd)
    lines = done.stderr.decode().splitlines()
    assert (done.returncode, done.stdout, len(lines)) == (2, b"", 1)
    return lines[0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("-w", NAME, "--rotate", "5"), "5 is neither a size of 100 kB or more"),
        (("-w", NAME, "--rotate", "1 day"), "1 day is neither a size of 100 kB or more"),
        (("-w", NAME, "--rotate", "1h", "--keep", "0"), "0 is not in the range"),
        (("-w", NAME, "--keep", "3"), "give --rotate too, when a part is full"),
        (("--rotate", "1h"), "--rotate is for a recording: name its file with -w"),
    ],
)
def test_wrong_values_are_told_and_nothing_is_made(
    tmp_path: Path, options: tuple[str, ...], words: str
) -> None:
    assert words in refused("sniff", "no-such-port", *options, cwd=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_settings_without_a_use_here_are_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "bilprov" / "config.toml"
    file.parent.mkdir()
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    file.write_text('[sniff]\nrotate = "1h"\nkeep = 3\n')
    assert "no-such-port" in refused("sniff", "no-such-port", cwd=tmp_path)
    file.write_text('[sniff]\nrotate = "1 day"\n')
    assert "neither a size" in refused("sniff", "no-such-port", cwd=tmp_path)


@pytest.mark.parametrize("more", [(), ("--rotate", "1h")])
@pytest.mark.parametrize("taken", [NAME, "drive.00001.mcap", "drive.00042.mcap"])
def test_a_name_that_is_taken_is_told_and_kept(
    tmp_path: Path, taken: str, more: tuple[str, ...]
) -> None:
    (tmp_path / taken).write_bytes(b"precious")
    with open_pty() as host:
        words = refused("sniff", host.name, "-w", NAME, *more, cwd=tmp_path)
    assert words.startswith(f"bilprov: {taken} exists and captures are never overwritten")
    assert (tmp_path / taken).read_bytes() == b"precious"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("more", [(), ("--rotate", "1h")])
def test_no_recording_goes_to_standard_output(tmp_path: Path, more: tuple[str, ...]) -> None:
    with open_pty() as host:
        words = refused("sniff", host.name, "-w", "-", *more, cwd=tmp_path)
    assert "a capture cannot be written to standard output: name a file" in words
    assert list(tmp_path.iterdir()) == []


def talk(pair: PtyPair, command: Running, data: bytes) -> None:
    """Say something, and wait until it is shown, so that nothing overruns the pty."""
    os.write(pair.master, data)
    shown = b""
    while shown.count(b"\n") < len(data) // 2:
        line = command.stdout.readline()
        assert line, command.stderr.read()
        shown += line


def until(condition: Callable[[], object]) -> None:
    give_up = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < give_up
        time.sleep(0.005)


def kept(path: Path) -> bytes:
    return b"".join(event.data for event in open_capture(path) if isinstance(event, Chunk))


def speeds(draw: random.Random, frames: int) -> bytes:
    return b"".join(bytes([0x11, draw.randrange(256)]) for _ in range(frames))


def talk_until(
    part: Path, host: PtyPair, command: Running, draw: random.Random, pause: float = 0.0
) -> bytes:
    """Say random speeds until a part of the recording is there; returns all that was said."""
    said = b""
    command.wait_for(part.with_name("drive.00001.mcap"))
    while not part.exists():
        data = speeds(draw, 20)
        said += data
        talk(host, command, data)
        time.sleep(pause)
    return said


@pytest.mark.waits
def test_a_log_goes_on_from_part_to_part_and_the_oldest_go(tmp_path: Path) -> None:
    path = tmp_path / NAME
    foreign = tmp_path / "drive.1.mcap"
    foreign.write_bytes(b"precious")
    with (
        open_pty() as host,
        running(
            *("sniff", host.name, "-w", str(path), "--format", "jsonl"),
            *("--rotate", "1s", "--keep", "2"),
        ) as command,
    ):
        said = talk_until(part_path(path, 4), host, command, random.Random(1), 0.05)
        code, out, err = command.end()
    first, last = min(part_paths(path)), max(part_paths(path))
    assert (code, last - first, first >= 3) == (0, 1, True)
    (totals,) = err.decode().splitlines()
    names = f"{part_path(path, first)} to {part_path(path, last)}"
    assert totals == f"{len(said) // 2:,} instructions, 0 answers, 0 faults in {names}"
    assert said.endswith(kept(path))
    assert b"".join(kept(part) for part in part_paths(path).values()) == kept(path)
    assert foreign.read_bytes() == b"precious"
    assert [open_capture(part).unfinished for part in part_paths(path).values()] == [False] * 2
    replayed = commands.command("replay", str(path), "--rate", "0", "--format", "jsonl")
    assert replayed.returncode == 0
    assert b"older parts are not there" in replayed.stderr
    shown = [row for row in json_lines(replayed.stdout) if row["kind"] == "instruction"]
    assert len(shown) == len(kept(path)) // 2
    assert json_lines(out) == []


@pytest.mark.waits
def test_count_ends_a_quiet_log_in_parts(tmp_path: Path) -> None:
    path = tmp_path / NAME
    with (
        open_pty() as host,
        running(
            *("sniff", host.name, "-w", str(path), "--quiet", "--count", "3"),
            *("--rotate", "1s"),
        ) as command,
    ):
        command.wait_for(part_path(path, 1))
        os.write(host.master, b"\x11\x01")
        command.wait_for(part_path(path, 2))
        os.write(host.master, b"\x11\x02\x11\x03")
        code, out, err = command.result()
    names = f"{part_path(path, 1)} to {part_path(path, max(part_paths(path)))}"
    assert (code, out) == (0, b"")
    assert err.decode() == f"3 instructions, 0 answers, 0 faults in {names}\n"
    assert kept(path) == b"\x11\x01\x11\x02\x11\x03"


@pytest.mark.waits
def test_a_disk_that_fills_up_before_a_seam_ends_the_recording_alone(tmp_path: Path) -> None:
    path = tmp_path / NAME
    first = part_path(path, 1)
    with (
        open_pty() as host,
        running(
            *("sniff", host.name, "-w", str(path), "--format", "jsonl", "--rotate", "1s")
        ) as command,
    ):
        command.wait_for(first)
        talk(host, command, b"\x11\x01")
        until(lambda: kept(first) == b"\x11\x01")
        size = first.stat().st_size
        resource.prlimit(command.process.pid, resource.RLIMIT_FSIZE, (size, size))
        at_once = command.stderr.readline().decode()  # at the seam, where nothing was said
        talk(host, command, b"\x11\x02\x11\x03")
        code, _, err = command.end()
    totals, sentence = err.decode().splitlines()
    assert code == 2
    assert at_once == f"{sentence}; listening goes on, without recording\n"
    assert sentence.startswith("bilprov: disk full: what was captured until ")
    assert totals == "3 instructions, 0 answers, 0 faults"
    assert part_paths(path) == {1: first}
    assert kept(path) == b"\x11\x01"


@pytest.mark.waits
def test_a_bridge_hands_on_though_a_part_cannot_be_closed(
    tmp_path: Path, protocol: Protocol
) -> None:
    path = tmp_path / NAME
    with (
        served(PtyRobot(protocol)) as port,
        running(
            *("sniff", "--bridge", port, "-w", str(path), "--format", "jsonl", "--rotate", "1s")
        ) as command,
    ):
        name = command.stderr.readline().decode().strip()
        command.wait_for(part_path(path, 2))
        # With room for the next part, and for all of its end but the last bytes.
        size = part_path(path, 1).stat().st_size - 100
        resource.prlimit(command.process.pid, resource.RLIMIT_FSIZE, (size, size))
        descriptor = os.open(name, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(descriptor, b"\x20")  # a part in which nothing was said is not closed
            answers = os.read(descriptor, 1)
            at_once = command.stderr.readline().decode()
            os.write(descriptor, b"\x20")
            answers += os.read(descriptor, 1)
        finally:
            os.close(descriptor)
        code, out, err = command.end()
    sentence = err.decode().splitlines()[-1]
    assert (answers, code, len(json_lines(out))) == (b"\x00" * 2, 2, 4)
    assert at_once == f"{sentence}; listening goes on, without recording\n"
    assert sentence.startswith("bilprov: disk full: what was captured until ")
    assert not open_capture(part_path(path, 1)).unfinished


@pytest.mark.waits
def test_a_part_that_is_deleted_while_it_is_written_leaves_those_before_it(tmp_path: Path) -> None:
    path = tmp_path / NAME
    with (
        open_pty() as host,
        running(
            *("sniff", host.name, "-w", str(path), "--format", "jsonl", "--rotate", "1s")
        ) as command,
    ):
        command.wait_for(part_path(path, 1))
        talk(host, command, b"\x11\x01")
        command.wait_for(part_path(path, 2))
        part_path(path, 2).unlink()
        talk(host, command, b"\x11\x02")
        assert b"drive.00002.mcap was deleted while recording" in command.stderr.readline()
        talk(host, command, b"\x11\x03")
        code, _, err = command.end()
    assert code == 2
    assert "was deleted while recording" in err.decode().splitlines()[-1]
    assert kept(path) == b"\x11\x01"


@pytest.mark.waits
@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", range(4))
def test_kill_9_leaves_what_was_said_from_its_begin_on(tmp_path: Path, seed: int) -> None:
    path = tmp_path / NAME
    with (
        open_pty() as host,
        running(
            *("sniff", host.name, "-w", str(path), "--format", "jsonl", "--rotate", "1s")
        ) as command,
    ):
        said = talk_until(part_path(path, 3), host, command, random.Random(seed))
        command.end(signal.SIGKILL)
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
    metadata = session_metadata(
        protocol, ports={}, line="", timeout=50 * MS, skew=0, heard=("host", "device")
    )
    talk = attached(protocol, Talk(faulty=0.1, pause=15 * MS), random.Random(3), 400)
    for folder, rotation in ((one, None), (several, Rotation(age=400 * MS))):
        decoder = StreamDecoder(protocol, timeout=50 * MS, skew=0)
        with Recorder(folder / NAME, START, metadata, rotation) as recorder:
            pipeline = Pipeline(decoder, Statistics(), Shown(NoOutput()), recorder)
            for event in talk.events:
                pipeline.events([event])
            pipeline.finish()
    assert len(part_paths(several / NAME)) > 4
    assert open_capture(one / NAME).contents.last > START + SECONDS * 10**9
    return one, several


READING = [
    "replay drive.mcap --rate 0 --format jsonl",
    "replay drive.mcap --rate 0 --start 1.5 --end 2.5",
    "replay drive.mcap --rate 0 --judge --count 50",
    "replay drive.mcap --rate 0 --filter faulty --format csv",
    "decode drive.mcap --format jsonl",
    "stats drive.mcap --json -",
    "export drive.mcap --format csv -o -",
    "export drive.mcap --format jsonl -o -",
    "export drive.mcap --format pcapng -o OUT",
    "plot drive.mcap --html OUT",
    "capture cut drive.mcap OUT --start 0.5 --end 2.5",
    "capture cut drive.mcap OUT --filter faulty",
    "capture repair drive.mcap OUT",
    "capture decode drive.mcap OUT",
    "capture diff drive.mcap ONE --json -",
    "capture diff ONE drive.mcap",
    "capture join drive.mcap LATER -o OUT",
]


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
    assert results[0][0] in ((0, 1) if "--judge" in line else (0,)), results[0][1]
    assert any(results[0][1]) or content


def test_info_and_doctor_tell_of_the_parts(both: tuple[Path, Path], tmp_path: Path) -> None:
    _, several = both
    told = [
        json.loads(commands.command("capture", "info", NAME, "--format", "json", cwd=folder).stdout)
        for folder in both
    ]
    names = [path.name for path in part_paths(several / NAME).values()]
    assert [summary["parts"] for summary in told] == [[], names]
    same = {"path", "start", "end", "zero", "duration", "bytes", "metadata", "unfinished"}
    assert {key: told[0][key] for key in same} == {key: told[1][key] for key in same}
    assert told[0]["counts"]["/host/raw"] == told[1]["counts"]["/host/raw"]
    text = commands.command("capture", "info", NAME, cwd=several).stdout.decode()
    assert f"{len(names)} parts, {names[0]} to {names[-1]}" in text
    part = json.loads(
        commands.command("capture", "info", names[2], "--format", "json", cwd=several).stdout
    )
    assert (part["metadata"]["part"], part["parts"]) == ("3", [])
    assert 0 < part["duration"] < 1
    assert commands.command("capture", "check", NAME, cwd=several).returncode == 0
    shutil.copytree(several, tmp_path / "torn")
    part_path(tmp_path / "torn" / NAME, 3).unlink()
    done = commands.command("capture", "check", NAME, cwd=tmp_path / "torn")
    assert done.returncode == 2
    assert b"part 3 (drive.00003.mcap) is missing" in done.stdout
    replayed = commands.command("replay", NAME, "--rate", "0", cwd=tmp_path / "torn")
    assert replayed.returncode == 0
    assert b"part 3 (drive.00003.mcap) is missing" in replayed.stderr


def test_parts_that_follow_each_other_are_joined_without_a_gap(
    both: tuple[Path, Path], tmp_path: Path
) -> None:
    _, several = both
    parts = list(part_paths(several / NAME).values())
    whole = tmp_path / "whole.mcap"
    done = commands.command("capture", "join", *map(str, reversed(parts)), "-o", str(whole))
    assert done.returncode == 0, done.stderr
    assert commands.command("capture", "diff", str(whole), str(several / NAME)).returncode == 0
    chunks = [event for event in open_capture(several / NAME) if isinstance(event, Chunk)]
    assert [event for event in open_capture(whole) if isinstance(event, Chunk)] == chunks
    fewer = tmp_path / "fewer.mcap"
    apart = [str(parts[0]), str(parts[2])]
    assert commands.command("capture", "join", *apart, "-o", str(fewer)).returncode == 0
    (gap,) = (event for event in open_capture(fewer) if not isinstance(event, Chunk))
    assert (gap.event, gap.detail) == ("gap", "drive.00003.mcap begins here")


def test_a_part_is_never_overwritten_by_what_is_read_from_it(
    both: tuple[Path, Path], tmp_path: Path
) -> None:
    folder = tmp_path / "several"
    shutil.copytree(both[1], folder)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    for line in (
        "capture cut drive.mcap drive.00002.mcap --end 1 --force",
        "export drive.mcap --format csv -o drive.00001.mcap --force",
        "plot drive.mcap --html drive.00003.mcap --force",
        "capture cut drive.mcap drive.mcap --end 1 --force",
    ):
        assert "would overwrite the input" in refused(*line.split(), cwd=folder)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_a_recording_in_parts_is_not_hidden(both: tuple[Path, Path], tmp_path: Path) -> None:
    one, several = (folder / NAME for folder in both)
    shutil.copy(part_path(several, 1), tmp_path)

    words = refused("capture", "cut", str(one), NAME, "--end", "1", "--force", cwd=tmp_path)

    assert "OUT drive.mcap is the name of a recording in parts, drive.00001.mcap and so on" in words
    assert len(list(tmp_path.iterdir())) == 1


def test_a_missing_recording_of_parts_is_a_missing_file(tmp_path: Path) -> None:
    (tmp_path / "drive.1.mcap").touch()
    assert "drive.mcap does not exist: name an MCAP file" in refused(
        "capture", "info", NAME, cwd=tmp_path
    )
    words = refused("recheck", NAME, cwd=tmp_path)
    assert "drive.mcap does not exist" in words


def test_recheck_says_that_parts_are_no_recorded_run(both: tuple[Path, Path]) -> None:
    words = refused("recheck", NAME, cwd=both[1])
    assert "is kept in parts" in words
