"""Broken output streams: no verdict without complete output; other commands end with their reader.

The tests run real processes on pipes that nobody reads, full devices, closed streams and terminals
that are hung up. What is written to files instead is tested in test_written_files.py.
"""

from __future__ import annotations

import fcntl
import json
import os
import shlex
import signal
import subprocess
import sys
import termios
import time
from contextlib import suppress
from itertools import product
from pathlib import Path

import pytest

from bilprov.analyzer.transport.port import open_pty
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk
from tests.support import ROOT
from tests.support.commands import PATIENCE, Done, command, running
from tests.support.reports import timeless
from tests.support.robots import sentence, simulate, until

pytestmark = pytest.mark.waits

PAGE = 4096  # bytes, the least that a pipe holds

# How a shell leads the streams to the sink, which is its standard input.
STREAMS = {"stdout": ">&0", "stderr": "2>&0", "both": ">&0 2>&0"}
CLOSED = {"stdout": ">&-", "stderr": "2>&-", "both": ">&- 2>&-"}
BREAKS = ("closed", "unread", "read in part", "full", "hung up")


def started(redirections: str, stdin: int, *arguments: str) -> subprocess.Popen[bytes]:
    """The command in a shell that redirects its streams; those that are left can be read."""
    shell = ["/bin/sh", "-c", f'exec "$@" {redirections}', "sh"]
    words = [*shell, sys.executable, "-m", "bilprov", *arguments]
    piped = subprocess.PIPE
    return subprocess.Popen(words, stdin=stdin, stdout=piped, stderr=piped, cwd=ROOT)


def broken(stream: str, how: str, *arguments: str, said: int = PAGE) -> Done:
    """The command, with the streams that are left captured; `said` is how much goes to the sink.

    One that is `read late` is a full, non-blocking pipe, and comes back as if it were captured.
    """
    reader, filled = -1, 0
    if how == "hung up":
        with open_pty() as terminal:
            end = os.open(terminal.name, os.O_WRONLY | os.O_NOCTTY)
    elif how == "full":
        end = os.open("/dev/full", os.O_WRONLY)
    else:
        reader, end = os.pipe()
    if how == "read in part":
        # With room for all that will be said but a byte, as far as one page goes.
        fcntl.fcntl(end, fcntl.F_SETPIPE_SZ, PAGE)
        filled = os.write(end, bytes(min(PAGE, max(0, PAGE + 1 - said))))
    elif how == "read late":
        fcntl.fcntl(end, fcntl.F_SETPIPE_SZ, PAGE)
        os.set_blocking(end, False)
        filled = os.write(end, bytes(PAGE))
    elif reader >= 0:
        os.close(reader)
    redirections = CLOSED[stream] if how == "closed" else STREAMS[stream]
    process = started(f"{redirections} </dev/null", end, *arguments)
    os.close(end)
    late = b""
    if how == "read in part":
        read_and_gone(reader, filled)
    elif how == "read late":
        with suppress(subprocess.TimeoutExpired):
            process.wait(1.0)
        with os.fdopen(reader, "rb") as sink:
            late = sink.read()[filled:]
    out, err = process.communicate(timeout=PATIENCE)
    return subprocess.CompletedProcess(arguments, process.returncode, out or late, err or late)


def read_and_gone(reader: int, filled: int) -> None:
    """Take some bytes more than were there, and go. Where all come in one write, go without."""
    give_up = time.monotonic() + 1
    while time.monotonic() < give_up:
        waiting = fcntl.ioctl(reader, termios.FIONREAD, bytes(4))
        if int.from_bytes(waiting, sys.byteorder) > filled:
            os.read(reader, filled + 1)
            break
        time.sleep(0.01)
    os.close(reader)


FAULTS = {"good": "", "faulty": "--fault ok-to-unknown-id"}
FEW = "--level smoke --only unused-id/9/*"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recorded runs `good.mcap` and `faulty.mcap`, and their reports `.json`."""
    folder = tmp_path_factory.mktemp("runs")
    for robot, fault in FAULTS.items():
        run = f"{folder}/{robot}"
        words = f"conform sim {fault} {FEW} --record {run}.mcap --json {run}.json"
        made = command(*words.split())
        assert made.returncode in (0, 1), made.stderr
    return folder


# The commands whose exit code is a verdict: {runs} is the folder above, {new} one for what is
# written, {robot} and {fault} whose run it is.
JUDGING = {
    "conform": f"conform sim {{fault}} {FEW} --json {{new}}/a.json --html {{new}}/a.html "
    "--junit {new}/a.xml --markdown {new}/a.md --profile {new}/new.toml",
    "conform, shown": f"conform sim {{fault}} {FEW} --markdown - --html {{new}}/a.html",
    "recheck": "recheck {runs}/{robot}.mcap --json -",
    "recheck, file": "recheck {runs}/{robot}.mcap --json {new}/a.json",
    "report": "report {runs}/{robot}.json --html - --markdown {new}/a.md",
    "report, shown": "report {runs}/{robot}.json",
    "replay": "replay {runs}/{robot}.mcap --rate 0 --judge",
    "replay, jsonl": "replay {runs}/{robot}.mcap --rate 0 --judge --format jsonl",
    "compare": "capture diff {runs}/good.mcap {runs}/{robot}.mcap --json {new}/a.json",
    "compare, json": "capture diff {runs}/good.mcap {runs}/{robot}.mcap --json -",
    "learn": "lab learn sim {fault} --dot {new}/a.dot",
}


def written(folder: Path) -> dict[str, bytes]:
    """The files in a folder, without its name."""
    return {f.name: timeless(f.read_bytes()).replace(bytes(folder), b"") for f in folder.iterdir()}


ROWS = list(product(JUDGING, FAULTS, STREAMS, BREAKS))


@pytest.mark.sample(1)
@pytest.mark.parametrize(("name", "robot", "stream", "how"), ROWS)
def test_a_verdict_is_given_only_where_everything_was_shown_and_written(
    name: str,
    robot: str,
    stream: str,
    how: str,
    runs: Path,
    tmp_path: Path,
) -> None:
    def words(new: Path) -> list[str]:
        new.mkdir()
        return JUDGING[name].format(runs=runs, new=new, robot=robot, fault=FAULTS[robot]).split()

    whole = command(*words(tmp_path / "whole"))
    said = {"stdout": whole.stdout, "stderr": whole.stderr, "both": whole.stdout + whole.stderr}
    lost = said[stream]

    result = broken(stream, how, *words(tmp_path / "new"), said=len(lost))

    assert result.returncode == (2 if lost else whole.returncode), result
    assert written(tmp_path / "new") == written(tmp_path / "whole")
    if stream != "stdout":
        assert result.stderr == b""
    elif lost:
        assert sentence(result).startswith("bilprov: standard output")
    if stream == "stderr":
        assert timeless(result.stdout) == timeless(whole.stdout)


# -- robots that move ------------------------------------------------------------------------------

# What drives a robot on a port; a frame with an unused ID is answered OK by the faulty one.
DRIVING = {
    "conform": f"conform {{port}} --probe {{probe}} {FEW} --json {{new}}/a.json",
    "send": "send {port} 'Speed 255' Forward 90",
    "send, expecting": "send {port} 'Speed 255' Forward 90 --expect OK,OK,BAD_HEADER",
    "replay": "replay {runs}/good.mcap --to {port} --rate 0 --duration 0.1",
    "shell": "send {port} --probe {probe}",
}


@pytest.mark.sample(1)
@pytest.mark.parametrize("fault", ["", "ok-to-unknown-id"])
@pytest.mark.parametrize("how", BREAKS)
@pytest.mark.parametrize("stream", STREAMS)
@pytest.mark.parametrize("name", DRIVING)
def test_a_robot_is_left_at_rest_and_not_judged_where_the_screen_broke(
    name: str, stream: str, how: str, fault: str, runs: Path, tmp_path: Path
) -> None:
    with simulate(*(["--fault", fault] if fault else [])) as robot:
        given = DRIVING[name].format(port=robot.port, probe=robot.probe, new=tmp_path, runs=runs)
        result = broken(stream, how, *shlex.split(given), "--yes", said=8)
        moving = robot.state()["moving"]

    assert moving is False
    if name in ("conform", "send, expecting"):
        silent = name != "conform" and stream == "stderr" and not fault
        assert result.returncode == (0 if silent else 2), result
    else:
        # No verdicts: they end when nobody reads, and only a disk or a terminal is an error.
        fails = stream != "stderr" and how in ("full", "hung up")
        assert result.returncode in ((0, 2) if fails else (0, 1)), result
    if name == "conform":
        report = json.loads((tmp_path / "a.json").read_bytes())
        assert (report["exit"] == 1) is bool(fault)
        assert not report["ended"]


@pytest.mark.sample(1)
def test_a_signal_stops_the_robot_while_its_terminal_takes_no_output() -> None:
    drive = ["Speed 255", "Forward", *(["LED 1", "pause=100"] * 200)]
    with simulate() as robot, open_pty() as terminal:
        slave = os.open(terminal.name, os.O_RDWR | os.O_NOCTTY)
        words = [sys.executable, "-m", "bilprov", "send", robot.port, *drive, "--yes"]
        process = subprocess.Popen(words, stdin=slave, stdout=slave, stderr=slave)
        until(lambda: robot.state()["moving"])
        termios.tcflow(slave, termios.TCOOFF)  # as Ctrl-S does
        time.sleep(0.5)
        process.terminate()
        until(lambda: not robot.state()["moving"])
        termios.tcflow(slave, termios.TCOON)
        process.wait(PATIENCE)
        os.close(slave)

    assert process.returncode == 1


QUIET = [
    ("decode", "00"),
    ("spec", "show"),
    ("encode", "Stop"),
    ("conform", "sim", "--level", "smoke", "--list"),
    ("simulate", "--list-faults"),
    ("ports", "/dev/null"),
    ("--help",),
]


@pytest.mark.sample(2)
@pytest.mark.parametrize("how", ["closed", "unread"])
@pytest.mark.parametrize("arguments", QUIET, ids=lambda words: words[0])
def test_any_other_command_ends_quietly_when_nobody_reads(
    arguments: tuple[str, ...], how: str
) -> None:
    both, alone = (broken(stream, how, *arguments) for stream in ("both", "stdout"))

    assert (both.returncode, both.stdout, both.stderr) == (0, b"", b"")
    assert (alone.returncode, alone.stdout, alone.stderr) == (0, b"", b"")


@pytest.mark.parametrize(("closed", "shown"), [("<&- >&-", b""), ("<&- 2>&-", b"00\n")])
def test_standard_input_that_is_closed_from_the_start_stops_no_command(
    closed: str, shown: bytes
) -> None:
    process = started(closed, subprocess.DEVNULL, "encode", "Stop")
    out, _ = process.communicate(timeout=PATIENCE)

    assert (process.returncode, out) == (0, shown)


def test_sniffing_ends_when_nobody_reads_and_its_file_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with open_pty() as host, running("sniff", host.name, "-w", str(path)) as sniffing:
        sniffing.wait_for(path)
        sniffing.stdout.close()
        while sniffing.process.poll() is None:
            os.write(host.master, b"\x20")
            with suppress(subprocess.TimeoutExpired):
                sniffing.process.wait(0.05)
        error = sniffing.stderr.read()

    assert (sniffing.process.returncode, error) == (0, b"")
    assert not open_capture(path).unfinished


# What takes long enough for the terminal to go away while the robot moves.
LONG = {
    "conform": "conform {port} --probe {probe} --level smoke --json {new}/a.json",
    "learn": "lab learn {port} --probe {probe} --dot {new}/a.dot",
    "send": "send {port} 'Speed 255' Forward pause=60000",
    "replay": "replay {runs}/good.mcap --to {port} --rate 0.01",
}


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", LONG)
def test_a_terminal_that_goes_away_ends_what_drives_the_robot_without_a_verdict(
    name: str, runs: Path, tmp_path: Path
) -> None:
    with simulate() as robot, open_pty() as terminal:
        given = LONG[name].format(port=robot.port, probe=robot.probe, runs=runs, new=tmp_path)
        # The leader of a session that opens a terminal has it as its own, and is hung up on.
        process = subprocess.Popen(
            [
                *("/bin/sh", "-c", 'tty=$1; shift; exec "$@" <$tty >$tty 2>&1', "sh"),
                *(terminal.name, sys.executable, "-m", "bilprov", *shlex.split(given), "--yes"),
            ],
            cwd=ROOT,
            start_new_session=True,
        )
        while not robot.state()["moving"]:
            assert process.poll() is None
        terminal.close()
        code = process.wait(PATIENCE)
        moving = robot.state()["moving"]

    # Where there is a verdict, the screen that should have shown it is gone. The others end because
    # of that; where they just wrote to it, it is an error too.
    assert code in ((2,) if "--json" in given else (0, 1, 2))
    assert moving is False
    assert [json.loads(file.read_bytes())["exit"] for file in tmp_path.iterdir()] == (
        [3] if "--json" in given else []
    )


# -- streams that are non-blocking -----------------------------------------------------------------

SLOWLY_READ = {
    "conform": f"conform sim {FEW} -v",
    "cases": "conform sim --list --level smoke",
    "faults": "simulate --list-faults",
    "replay": "replay {runs}/good.mcap --rate 0 --format jsonl",
    "export": "export {runs}/good.mcap -o - --format jsonl",
    "send": "send {port} Stop 'Speed 255' Forward Stop --yes",
}


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", SLOWLY_READ)
def test_a_slow_reader_of_a_nonblocking_stream_is_waited_for(name: str, runs: Path) -> None:
    with simulate() as robot:
        given = shlex.split(SLOWLY_READ[name].format(runs=runs, port=robot.port))
        whole = command(*given)
        result = broken("stdout", "read late", *given)
        moving = robot.state()["moving"]

    assert (result.returncode, moving) == (whole.returncode, False), result
    if name in ("send", "conform"):  # which show times
        assert len(result.stdout.splitlines()) == len(whole.stdout.splitlines())
    else:
        assert result.stdout == whole.stdout


def test_an_error_is_said_though_standard_error_is_nonblocking() -> None:
    assert broken("stderr", "read late", "decode", "zz").stderr == command("decode", "zz").stderr


def test_a_recording_goes_on_while_a_nonblocking_stream_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    reader, end = os.pipe()
    os.set_blocking(end, False)
    with open_pty() as host, os.fdopen(reader, "rb") as said:
        words = ("sniff", host.name, "-w", str(path), "--format", "jsonl")
        process = started(f"{STREAMS['stdout']} </dev/null", end, *words)
        os.close(end)
        give_up = time.monotonic() + PATIENCE
        while not path.exists():
            assert time.monotonic() < give_up
        for count in range(1, 5):
            os.write(host.master, b"\x00" * 1000)  # more text than a pipe takes
            while path.stat().st_size == 0 or recorded(path) < 1000 * count:
                assert process.poll() is None, process.communicate()
                assert time.monotonic() < give_up
        process.send_signal(signal.SIGINT)
        shown = said.read()
        _, err = process.communicate(timeout=PATIENCE)

    shown_bytes = sum(len(bytes.fromhex(json.loads(line)["hex"])) for line in shown.splitlines())
    assert (process.returncode, shown_bytes) == (0, 4000), err


def recorded(path: Path) -> int:
    return sum(len(event.data) for event in open_capture(path) if isinstance(event, Chunk))
