"""Broken output streams: no verdict without complete output; other commands end with their reader.

The tests run real processes on pipes that nobody reads, full devices and closed streams.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from bilprov.analyzer.transport.pty import open_pty
from bilprov.captures.reader import open_capture
from tests.support import ROOT
from tests.support.commands import PATIENCE, command
from tests.support.reports import timeless
from tests.support.robots import sentence, simulate
from tests.support.signals import ignoring
from tests.support.wires import running

pytestmark = pytest.mark.waits

Result = subprocess.CompletedProcess[bytes]

# How a shell breaks the streams; its standard input is the end of a pipe that nobody reads.
BREAKS = {
    "nobody reads stdout": ">&0",
    "nobody reads stderr": "2>&0",
    "nobody reads either": ">&0 2>&0",
    "stdout closed": ">&-",
    "stderr closed": "2>&-",
    "stdout full": ">/dev/full",
    "stderr full": "2>/dev/full",
}


def broken(redirections: str, *arguments: str) -> Result:
    """The command, with the streams that are left captured."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        return subprocess.run(
            [
                *("/bin/sh", "-c", f'exec "$@" {redirections} </dev/null', "sh"),
                *(sys.executable, "-m", "bilprov", *arguments),
            ],
            stdin=writer,
            capture_output=True,
            cwd=ROOT,
            timeout=PATIENCE,
            check=False,
        )
    finally:
        os.close(writer)


@dataclass(frozen=True)
class Ended:
    """How a command ended, and the files that it wrote."""

    code: int
    out: bytes
    err: bytes
    files: dict[str, bytes]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recorded run (`run.mcap`, `run.json`) and two shards (`1.json`, `2.json`)."""
    folder = tmp_path_factory.mktemp("runs")
    few = ("--only", "valid/LED/*", "--fault", "led-order-reversed")
    asked = {
        "run": ("--record", str(folder / "run.mcap")),
        "1": ("--shard", "1/2"),
        "2": ("--shard", "2/2"),
    }
    for name, more in asked.items():
        made = command("conform", "sim", *few, *more, "--json", str(folder / f"{name}.json"))
        assert made.returncode in (0, 1), made.stderr
    return folder


# {runs} is the folder above, {new} one for what is written. Most say something on both streams.
FEW = "--only valid/LED/1 --json {new}/a.json --html {new}/a.html --junit {new}/a.xml"
JUDGING = {
    "conform": f"conform sim {FEW} --markdown {{new}}/a.md --profile {{new}}/new.toml",
    "recheck": "recheck {runs}/run.mcap --json -",
    "merge": "merge {runs}/1.json {runs}/2.json --json -",
    "report": "report {runs}/run.json --html - --markdown {new}/a.md",
    "replay": "replay {runs}/run.mcap --rate 0 --judge",
}
EACH = [
    "nobody reads stdout",
    "nobody reads stderr",
    "nobody reads either",
    "stdout closed",
    "stdout full",
]
OTHERS = {
    "conform, asked": f"conform sim {FEW} --markdown - --fault always-1",
    "recheck, file": "recheck {runs}/run.mcap --json {new}/a.json",
    "merge, file": "merge {runs}/1.json {runs}/2.json --json {new}/a.json",
    "report, shown": "report {runs}/run.json",
    "replay, jsonl": "replay {runs}/run.mcap --rate 0 --judge --format jsonl",
}
ROWS = [
    *((name, how) for name in JUDGING for how in EACH),
    *((name, "nobody reads either") for name in OTHERS),
    ("conform", "stderr full"),
    ("conform", "stderr closed"),
    ("conform, asked", "nobody reads stderr"),
    ("recheck, file", "stderr closed"),
]


def words(name: str, runs: Path, new: Path) -> list[str]:
    template = JUDGING.get(name) or OTHERS[name]
    return [word.format(runs=runs, new=new) for word in template.split()]


def written(folder: Path) -> dict[str, bytes]:
    """The files in a folder, without its name."""
    return {f.name: timeless(f.read_bytes()).replace(bytes(folder), b"") for f in folder.iterdir()}


@pytest.fixture(scope="module")
def whole(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Ended]:
    """How a command ends when nothing breaks."""

    @cache
    def ended(name: str) -> Ended:
        new = tmp_path_factory.mktemp("whole")
        result = command(*words(name, runs, new))
        assert result.returncode in (0, 1), result
        return Ended(result.returncode, result.stdout, result.stderr, written(new))

    return ended


@pytest.mark.sample(10)
@pytest.mark.parametrize(("name", "how"), ROWS)
def test_a_verdict_is_given_only_where_everything_was_shown_and_written(
    name: str, how: str, runs: Path, whole: Callable[[str], Ended], tmp_path: Path
) -> None:
    kept = whole(name)

    result = broken(BREAKS[how], *words(name, runs, tmp_path))

    spoken = {"stdout": kept.out, "stderr": kept.err}
    lost = {s for s, said in spoken.items() if said and (s in how or "either" in how)}
    assert result.returncode == (2 if lost else kept.code), result
    assert written(tmp_path) == kept.files
    if "either" in how or "stderr" in how:
        assert result.stderr == b""
    elif lost:
        assert sentence(result).startswith("bilprov: standard output")
    if lost == {"stderr"} and "either" not in how:
        assert timeless(result.stdout) == timeless(kept.out)


@pytest.mark.sample(3)
@pytest.mark.parametrize("fault", ["", "ok-to-unknown-id"])
@pytest.mark.parametrize("how", ["nobody reads either", "stdout closed", "stderr full"])
def test_a_robot_is_judged_and_left_at_rest_though_the_screen_broke(
    fault: str, how: str, tmp_path: Path
) -> None:
    report, capture = tmp_path / "a.json", tmp_path / "run.mcap"
    with simulate(*(["--fault", fault] if fault else [])) as robot:
        result = broken(
            BREAKS[how],
            *("conform", robot.port, "--yes", "--probe", robot.probe, "--only", "unused-id/9/*"),
            *("--json", str(report), "--record", str(capture)),
        )
        moving = robot.state()["moving"]

    assert result.returncode == 2
    told = json.loads(report.read_bytes())
    assert (told["exit"] == 1) is bool(fault)
    assert not told["ended"]
    assert not open_capture(capture).unfinished
    assert moving is False


def test_half_of_a_report_on_standard_output_is_no_verdict() -> None:
    reader, writer = os.pipe()
    with subprocess.Popen(
        [sys.executable, "-m", "bilprov", "conform", "sim", "--level", "smoke", "--json", "-"],
        stdout=writer,
        stderr=subprocess.PIPE,
        cwd=ROOT,
    ) as process:
        os.close(writer)
        assert os.read(reader, 10)[:1] == b"{"
        os.close(reader)
        _, err = process.communicate(timeout=PATIENCE)

    assert process.returncode == 2
    assert err.splitlines()[-1].startswith(b"bilprov: standard output: Broken pipe: ")


def test_a_recording_that_could_not_be_finished_is_no_verdict(tmp_path: Path) -> None:
    """A file size limit stands for a disk that is full when the run is over."""
    result = subprocess.run(
        [
            *("/bin/sh", "-c", 'ulimit -f 1; exec "$@"', "sh", sys.executable, "-m", "bilprov"),
            *("conform", "sim", "--only", "valid/LED/1", "--fault", "always-1"),
            *("--record", str(tmp_path / "run.mcap")),
        ],
        capture_output=True,
        cwd=ROOT,
        timeout=PATIENCE,
        check=False,
    )

    assert result.returncode == 2, result
    assert "run.mcap" in sentence(result)


def test_one_file_that_cannot_be_written_keeps_neither_the_others_nor_the_screen(
    tmp_path: Path,
) -> None:
    result = command(
        *("conform", "sim", "--only", "valid/LED/1", "--json", "-", "--junit", "/dev/full"),
        *("--html", str(tmp_path / "a.html")),
    )

    assert result.returncode == 2
    assert json.loads(result.stdout)["verdict"] == "pass"
    assert (tmp_path / "a.html").read_bytes().endswith(b"</html>\n")
    assert b"conforms" in result.stderr
    assert sentence(result) == "bilprov: No space left on device"


QUIET = [
    ("decode", "00"),
    ("spec", "show"),
    ("encode", "Stop"),
    ("conform", "sim", "--list"),
    ("simulate", "--list-faults"),
    ("score", "--only", "always-1", "--level", "smoke", "--jobs", "1"),
    ("--help",),
]


@pytest.mark.sample(4)
@pytest.mark.parametrize("arguments", QUIET, ids=lambda words: words[0])
def test_any_other_command_ends_quietly_when_nobody_reads(arguments: tuple[str, ...]) -> None:
    both, alone = (
        broken(BREAKS[f"nobody reads {which}"], *arguments) for which in ("either", "stdout")
    )

    assert (both.returncode, both.stdout, both.stderr) == (0, b"", b"")
    assert (alone.returncode, alone.stdout, alone.stderr) == (0, b"", b"")


def test_a_capture_is_replayed_until_nobody_reads(runs: Path) -> None:
    result = broken(BREAKS["nobody reads stdout"], "replay", str(runs / "run.mcap"), "--rate", "0")

    assert (result.returncode, result.stderr) == (0, b"")


def test_a_stream_that_is_closed_from_the_start_stops_no_other_command(tmp_path: Path) -> None:
    for redirections in (">&-", ">&- 2>&-", "<&- >&-"):
        assert broken(redirections, "spec", "show").returncode == 0
    told = broken("<&- 2>&-", "encode", "Stop")
    assert (told.returncode, told.stdout) == (0, b"00\n")


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


def test_a_terminal_that_goes_away_ends_the_run_with_its_report(tmp_path: Path) -> None:
    report = tmp_path / "a.json"
    with simulate() as robot, open_pty() as terminal:
        # The leader of a session that opens a terminal has it as its own, and is hung up on.
        with ignoring():
            process = subprocess.Popen(
                [
                    *("/bin/sh", "-c", 'tty=$1; shift; exec "$@" <$tty >$tty 2>&1', "sh"),
                    *(terminal.name, sys.executable, "-m", "bilprov", "conform", robot.port),
                    *("--yes", "--probe", robot.probe, "--json", str(report)),
                ],
                cwd=ROOT,
                start_new_session=True,
            )
        while not robot.state()["moving"]:
            assert process.poll() is None
        terminal.close()
        code = process.wait(PATIENCE)
        moving = robot.state()["moving"]

    assert code == 2  # the screen that should have shown the verdict is gone
    assert json.loads(report.read_bytes())["exit"] == 3
    assert moving is False
