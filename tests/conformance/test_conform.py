"""`bilprov conform` and `simulate` as processes: options, reports, recordings, exit codes."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bilprov.analyzer.transport.port import open_pty
from bilprov.captures.reader import open_capture
from bilprov.conformance.api import Options, conform, planned, run_suite, select_cases
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import device_target
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.commands import command, process
from tests.support.reports import timeless
from tests.support.robots import (
    PATIENCE,
    READING_CASES,
    Served,
    judged_exit,
    sentence,
    served_here,
    simulate,
)
from tests.support.signals import ignoring
from tests.support.wires import Running, running
from tests.vectors import READING_IDS

pytestmark = pytest.mark.waits

FEW = ("--only", "unused-id/9/?", "--only", "valid/LED/*")
SMOKE = ("--level", "smoke")  # whose cases are soon made

# -- the report -----------------------------------------------------------------------------------


class Node(dict[str, Any]):
    """A JSON object, whose values are attributes too."""

    __getattr__ = dict.__getitem__


def report_of(data: bytes) -> Node:
    """The report: pure JSON on one object."""
    assert data.endswith(b"\n")
    found = json.loads(data, object_hook=Node)
    assert isinstance(found, Node)
    return found


def test_the_report_is_pure_json_on_standard_output() -> None:
    result = command("conform", "sim", *FEW, "--json", "-")

    report = report_of(result.stdout)
    assert b"conforms" in result.stderr
    assert (report.device, report.seed, report.verdict, report.exit) == ("sim", 1, "pass", 0)
    assert report.counts["pass"] == len(report.cases) == 10 + 8 + len(OPENING) + READING_CASES
    sent = bytes.fromhex("".join(data for case in report.cases for data in case.sent))
    assert report.timing["bytes_sent"] > len(sent)
    for case in report.cases:
        assert case.axes
        assert case.reading is None or case.reading in READING_IDS
        assert case.id in case.reproduce
        assert {entry.kind for entry in case.log} >= ({"sent", "received"} if case.sent else set())


# -- choosing cases -------------------------------------------------------------------------------


# What every run begins with, whatever is chosen.
OPENING = [
    *("power-on/at-rest", "power-on/Speed", "link/unused-id", "link/too-few", "power-on/Forward"),
    "timing/truncation-timeout",
]


# -- wrong use ------------------------------------------------------------------------------------


@pytest.mark.parametrize("pty", [True, False])
def test_nothing_moves_without_a_word_from_the_user(protocol: Protocol, pty: bool) -> None:
    device = Simulator(protocol)
    with served_here(device, pty=pty) as (port, probe):
        result = command("conform", port, "--probe", probe, *FEW)

    assert result.returncode == 2
    assert "--yes" in sentence(result)
    assert "drive" in sentence(result)
    assert device.frames == 0
    assert device.deadline() is None


def test_a_recording_is_never_overwritten_and_that_is_known_before_anything_moves(
    protocol: Protocol, tmp_path: Path
) -> None:
    device, file = Simulator(protocol), tmp_path / "run.mcap"
    file.write_bytes(b"precious")
    with served_here(device) as (port, probe):
        result = command(*("conform", port, "--probe", probe, "--yes", "--record", str(file)), *FEW)

    assert result.returncode == 2
    assert str(file) in sentence(result)
    assert file.read_bytes() == b"precious"
    assert device.frames == 0


@pytest.mark.parametrize(("typed", "frames"), [(b"n\n", False), (b"y\n", True)])
def test_on_a_terminal_it_asks_once(
    protocol: Protocol, typed: bytes, frames: bool, tmp_path: Path
) -> None:
    device, file = Simulator(protocol), tmp_path / "report.json"
    with served_here(device) as (port, probe), open_pty() as terminal:
        slave = os.open(terminal.name, os.O_RDWR | os.O_NOCTTY)
        start = [sys.executable, "-m", "bilprov", "conform"]
        process = subprocess.Popen(
            [
                *(*start, port, "--probe", probe, "--level", "smoke", "--only", "valid/Stop"),
                *("--truncation-timeout", "50", "--json", str(file)),
            ],
            stdin=slave,
            stderr=slave,
            stdout=subprocess.PIPE,
            cwd=ROOT,
        )
        os.close(slave)
        told = b""
        while b"?" not in told:
            assert select.select([terminal.master], [], [], PATIENCE)[0], told
            told += os.read(terminal.master, 4096)
        os.write(terminal.master, typed)
        out, _ = process.communicate(timeout=PATIENCE)

    assert b"will move for about" in told
    assert (device.frames > 0) is frames
    if frames:
        assert judged_exit(process.returncode, json.loads(file.read_bytes())) == 0, out
    else:
        assert (process.returncode, file.exists()) == (2, False), out


# -- options --------------------------------------------------------------------------------------


@pytest.mark.parametrize("timeout", [None, 50.0])
def test_a_run_counts_as_many_cases_as_were_announced(
    protocol: Protocol, timeout: float | None
) -> None:
    options = Options(level="smoke", truncation_timeout=timeout)

    report = conform(grammar=protocol, options=options)

    assert len(report.results) == planned(protocol, options, select_cases(protocol, options))


def test_the_seed_is_reported_and_makes_the_run_the_same_again() -> None:
    runs = [
        command("conform", "sim", *FEW, "--seed", seed, "--json", "-").stdout
        for seed in ("9", "9", "10")
    ]

    assert report_of(runs[0]).seed == 9
    assert timeless(runs[0]) == timeless(runs[1])
    assert timeless(runs[0]) != timeless(runs[2])


# -- ends -----------------------------------------------------------------------------------------


def conforming(port: str, *arguments: str) -> AbstractContextManager[Running]:
    """A run on a served simulator that is under way."""
    return running("conform", port, "--yes", *SMOKE, *arguments)


def signalled_once_it_moves(
    run: Running, robot: Served, number: signal.Signals
) -> tuple[int, str, dict[str, Any]]:
    """Send a signal to a run while it drives: its exit code and output, and the robot's state."""
    while not robot.state()["moving"]:
        assert run.process.poll() is None
        time.sleep(0.01)
    code, out, err = run.end(number)
    assert b"Traceback" not in err, err.decode()
    return code, out.decode(), robot.state()


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("number", "ignored"),
    [
        (signal.SIGINT, []),
        (signal.SIGTERM, []),
        (signal.SIGHUP, []),
        (signal.SIGINT, [signal.SIGINT]),  # as a shell starts what is in the background
    ],
)
def test_ctrl_c_leaves_the_robot_at_rest_and_ends_with_3(
    tmp_path: Path, number: signal.Signals, ignored: list[signal.Signals]
) -> None:
    file, capture = tmp_path / "report.json", tmp_path / "run.mcap"
    with simulate() as robot:
        words = ("--probe", robot.probe, "--json", str(file), "--record", str(capture))
        with ignoring(*ignored), conforming(robot.port, *words) as run:
            code, out, state = signalled_once_it_moves(run, robot, number)

    assert code == 3, out
    assert state["moving"] is False
    report = report_of(file.read_bytes())
    assert report.exit == 3
    assert len({case.id for case in report.cases}) == len(report.cases) >= 35
    assert report.counts["inconclusive"] > 30
    assert "interrupted" in out
    assert not open_capture(capture).unfinished


class Heralding(Simulator):
    """Announces that a run is in its cases, by the number of bytes that it has received."""

    def __init__(self, protocol: Protocol, fault: str) -> None:
        super().__init__(protocol, fault_bank(protocol)[fault])
        self.in_its_cases = threading.Event()
        self._received = 0

    def receive(self, data: bytes, now: int) -> None:
        super().receive(data, now)
        self._received += len(data)
        if self._received > 1500:
            self.in_its_cases.set()


@pytest.mark.sample(1)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_ctrl_c_after_a_failure_ends_with_1(protocol: Protocol, number: signal.Signals) -> None:
    device = Heralding(protocol, "ok-to-unknown-id")
    with (
        served_here(device) as (port, probe),
        conforming(port, "--probe", probe, "--json", "-") as run,
    ):
        assert device.in_its_cases.wait(PATIENCE)  # the link check has failed by then
        code, out, _ = run.end(number)

    assert code == report_of(out).exit == 1
    assert not device.state.moving


def test_a_run_that_nohup_started_goes_on_without_its_terminal() -> None:
    with simulate() as robot:
        few = ("--level", "smoke", "--only", "unused-id/9/*", "--json", "-")
        words = ("--probe", robot.probe, *few)
        with ignoring(signal.SIGHUP), conforming(robot.port, *words) as run:
            code, out, _ = signalled_once_it_moves(run, robot, signal.SIGHUP)

    report = report_of(out.encode())
    assert code == report.exit != 1
    assert report.counts["pass"] > 10
    assert "interrupted" not in out


def test_a_recording_that_the_disk_cannot_take_ends_the_run_with_the_robot_at_rest(
    tmp_path: Path,
) -> None:
    """A file size limit stands for a full disk; SIGXFSZ is ignored, as Python does."""
    file = tmp_path / "run.mcap"
    with simulate() as served:
        result = subprocess.run(
            [
                *("/bin/sh", "-c", 'ulimit -f 200; exec "$@"', "sh"),
                *(sys.executable, "-m", "bilprov", "conform", served.port, "--yes"),
                *("--probe", served.probe, "--level", "smoke", "--record", str(file)),
            ],
            cwd=ROOT,
            capture_output=True,
            timeout=60,
        )
        state = served.state()

    assert result.returncode == 2, result
    assert b"Traceback" not in result.stderr
    assert b"run.mcap" in result.stdout  # it is why the run ended early
    assert b"interrupted" not in result.stdout
    assert state["moving"] is False
    assert open_capture(file).contents.counts["/host/raw"] > 0


def test_a_report_does_not_depend_on_the_order_of_a_set() -> None:
    """Two readings that come to the same verdict: the first by name is the one that is told."""
    words = ("conform", "sim", "--variant", "R-fault-state=both", "--level", "smoke", "--seed", "7")
    hashed = [
        json.loads(process(*words, "--json", "-", env={"PYTHONHASHSEED": seed}).stdout)["cases"]
        for seed in "12"
    ]

    assert hashed[0] == hashed[1]


def test_the_last_resort_is_for_runs_that_have_begun(protocol: Protocol) -> None:
    class Breaking(RunListener):
        """Fails at the first case."""

        def begin(self, ident: str) -> None:
            raise ZeroDivisionError

    halts: list[str] = []
    target = replace(
        device_target(protocol, Simulator(protocol)), halt=lambda: halts.append("halt")
    )

    with pytest.raises(ValueError, match="no case matches"):
        run_suite(target, Options(only=("nothing",)))
    assert not halts
    with pytest.raises(ZeroDivisionError):
        run_suite(target, Options(only=("valid/Stop",)), [Breaking()])
    assert halts == ["halt"]
    assert run_suite(target, Options(only=("valid/Stop",))).exit == 0
    assert halts == ["halt"]
