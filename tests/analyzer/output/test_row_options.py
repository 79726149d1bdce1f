"""`--time`, `--columns` and `--format csv` of sniff and replay; `--count` and `--duration`."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path

import pytest

from bilprov.analyzer.transport.pty import open_pty
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk, Line
from bilprov.captures.writer import CaptureWriter
from tests.support import ROOT
from tests.support.commands import command
from tests.support.decoding import MS, conversation
from tests.support.wires import json_lines, running

SAMPLE = ROOT / "captures" / "samples" / "examples.mcap"
START = 1_700_000_000_000_000_000  # 2023-11-14T22:13:20Z
TALK = [(b"\x11\x7f", b"\0"), (b"\x20", b"\0"), (b"\x81\x05", b"\0"), (b"\x90", b"\1")]


@pytest.fixture
def talk(tmp_path: Path) -> Path:
    path = tmp_path / "talk.mcap"
    metadata = {"attached": "no", "heard": "device host"}
    with CaptureWriter(path, start_wall=START, metadata=metadata, version="0") as writer:
        writer.write(Line(0, "open", "", "here"), 0)
        for event in conversation(TALK):
            assert isinstance(event, Chunk)
            writer.chunk(event)
    return path


def shown(path: Path, *more: str) -> list[str]:
    done = command("replay", str(path), "--rate", "0", *more, TZ="UTC")
    assert (done.returncode, done.stderr) == (0, b"")
    return done.stdout.decode().splitlines()


def test_lines_are_as_ever_but_for_the_time(talk: Path) -> None:
    usual = shown(talk)
    assert usual[:2] == [
        "    0.000000 - line open: here",
        "    0.020000 → 11 7f        Speed speed=127         stopped speed 127 led 0",
    ]
    for style, first, last in (
        ("relative", "    0.000000", "    0.081000"),
        ("delta", "    0.000000", "    0.001000"),
        ("absolute", "2023-11-14 22:13:20.000000", "2023-11-14 22:13:20.081000"),
        ("utc", "2023-11-14T22:13:20.000000Z", "2023-11-14T22:13:20.081000Z"),
    ):
        lines = shown(talk, "--time", style)
        assert [line[len(first) :] for line in lines] == [line[12:] for line in usual]
        assert (lines[0][: len(first)], lines[-1][: len(last)]) == (first, last)


def test_columns_stand_under_each_other_and_rows_are_those_of_the_json_lines(talk: Path) -> None:
    columns = "time,direction,hex,name,speed,latency,reason"
    lines = shown(talk, "--columns", columns, "--time", "utc")

    assert len(lines) == len(shown(talk, "--format", "jsonl")) == 8
    assert lines[0] == "2023-11-14T22:13:20.020000Z  host    11 7f        Speed            127"
    assert lines[1].split()[1:] == ["device", "00", "OK", "1.000", "ms"]
    assert lines[1].index("device") == lines[0].index("host")
    assert lines[6].index("no instruction has ID 9") > lines[1].index("ms")


def test_csv_has_a_header_and_the_values_of_the_json_lines(talk: Path) -> None:
    text = "\n".join(shown(talk, "--format", "csv"))
    rows = list(csv.DictReader(io.StringIO(text)))
    lines = json_lines("\n".join(shown(talk, "--format", "jsonl")).encode())

    assert [(float(row["t"]), row["hex"]) for row in rows] == [
        (line["t"], line["hex"]) for line in lines
    ]
    timed = shown(talk, "--format", "csv", "--time", "utc")
    assert timed[0].startswith("time,t,direction,")
    assert timed[1].startswith("2023-11-14T22:13:20.020000Z,0.02,host,")


def test_a_session_that_shows_nothing_has_a_header(talk: Path) -> None:
    (header,) = shown(talk, "--format", "csv", "--filter", "t > 1000", "--columns", "t,hex")

    assert header == "t,hex"


@pytest.mark.parametrize(
    ("more", "part"),
    [
        (["--columns", "nam"], "there is no column 'nam', did you mean name?"),
        (["--format", "jsonl", "--time", "utc"], "--time and --columns are for lines and csv"),
        (["--format", "jsonl", "--columns", "t"], "--time and --columns are for lines and csv"),
        (["--columns", "t,hex", "--time", "utc"], "name it in --columns too"),
        (["--count", "1", "--to", "/dev/null"], "--count counts the frames shown"),
        (["--time", "unix"], "'unix' is not one of"),
    ],
)
def test_wrong_use_is_one_sentence(talk: Path, more: list[str], part: str) -> None:
    done = command("replay", str(talk), *more)

    assert (done.returncode, done.stdout) == (2, b"")
    assert part in done.stderr.decode()
    assert done.stderr.count(b"\n") == 1


def test_count_ends_a_replay_after_so_many_frames_were_shown(talk: Path) -> None:
    every = shown(talk, "--format", "jsonl")

    assert shown(talk, "--format", "jsonl", "--count", "3") == every[:3]
    hosts = shown(talk, "--format", "jsonl", "--count", "2", "--filter", "direction == 'host'")
    assert hosts == [every[0], every[2]]
    assert shown(talk, "--format", "jsonl", "--count", "100") == every


@pytest.mark.waits
def test_count_does_not_wait_for_what_is_not_shown(tmp_path: Path) -> None:
    path = tmp_path / "slow.mcap"
    with CaptureWriter(path, start_wall=0, metadata={"attached": "no"}, version="0") as writer:
        writer.chunk(Chunk(0, "host", b"\x20"))
        writer.chunk(Chunk(1, "device", b"\0"))
        writer.chunk(Chunk(3_600_000 * MS, "host", b"\x00"))

    with running("replay", str(path), "--format", "jsonl", "--count", "1") as replay:
        code, out, _ = replay.result()

    assert (code, len(out.splitlines())) == (0, 1)


def test_duration_is_seconds_of_the_recording_from_where_it_begins(talk: Path) -> None:
    def times(*more: str) -> list[float]:
        done = command("replay", str(talk), "--rate", "0", "--format", "jsonl", *more)
        return [line["t"] for line in json_lines(done.stdout)]

    assert times("--duration", "0.03") == [0.02, 0.021]
    assert times("--start", "0.03", "--duration", "0.03") == [0.04, 0.041]
    for both in ("--duration", "9", "--end", "0.03"), ("--duration", "0.03", "--end", "9"):
        assert times(*both) == [0.02, 0.021]


@pytest.mark.waits
def test_sniff_writes_the_same(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    more = ["--format", "csv", "--columns", "time,t,hex", "--time", "utc", "--count", "2"]
    with (
        open_pty() as host,
        open_pty() as device,
        running("sniff", host.name, device.name, "-w", str(path), *more) as sniff,
    ):
        sniff.wait_for(path)
        os.write(host.master, b"\x20\x00")
        code, out, _ = sniff.result()

    header, *rows = csv.reader(io.StringIO(out.decode(), newline=""))
    assert (code, header) == (0, ["time", "t", "hex"])
    assert [row[2] for row in rows] == ["20", "00"]
    again = command("replay", str(path), "--rate", "0", *more)
    assert again.stdout == out
    start = open_capture(path).start
    wall = start + round(float(rows[0][1]) * 1e9)
    assert rows[0][0].endswith(f".{wall // 1000 % 1_000_000:06d}Z")


@pytest.mark.parametrize("time_style", ["relative", "delta", "absolute", "utc"])
def test_hostile_words_reach_no_terminal(tmp_path: Path, time_style: str) -> None:
    hostile = "\x1b]0;owned\x07\u202e"
    path = tmp_path / "a.mcap"
    with CaptureWriter(path, start_wall=START, metadata={}, version="0") as writer:
        writer.write(Line(0, "break", "", hostile), 0)
        writer.chunk(Chunk(0, "host", b"\0"))

    for line in shown(path, "--time", time_style, "--columns", "time,reason,faults,name"):
        assert line.isprintable()
