"""`bilprov conform` and `simulate` as processes: options, reports, recordings, exit codes."""

from __future__ import annotations

import json
import resource
import signal
import threading
import time
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bilprov.analyzer.transport.signals import handled
from bilprov.captures.reader import open_capture
from bilprov.conformance.api import Options, conform, planned, run_suite, select_cases
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import device_target
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.spec.protocol import Protocol
from tests.support.commands import Running, command, process, running
from tests.support.robots import PATIENCE, Served, judged_exit, sentence, served_here, simulate
from tests.support.terminals import on_terminal

pytestmark = pytest.mark.waits

FEW = ("--only", "unused-id/9/?", "--only", "valid/LED/*")
SMOKE = ("--level", "smoke")  # whose cases are soon made


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


@pytest.mark.parametrize(("typed", "frames"), [("n\r", False), ("y\r", True)])
def test_on_a_terminal_it_asks_once(
    protocol: Protocol, typed: str, frames: bool, tmp_path: Path
) -> None:
    device, file = Simulator(protocol), tmp_path / "report.json"
    words = ("--level", "smoke", "--only", "valid/Stop", "--truncation-timeout", "50")
    with (
        served_here(device) as (port, probe),
        on_terminal("conform", port, "--probe", probe, *words, "--json", str(file)) as terminal,
    ):
        terminal.wait_for("will move for about")
        terminal.wait_for("?")
        terminal.type(typed)
        code = terminal.end()

    assert (device.frames > 0) is frames
    if frames:
        assert judged_exit(code, json.loads(file.read_bytes())) == 0, terminal.shown
    else:
        assert (code, file.exists()) == (2, False), terminal.shown


# -- options --------------------------------------------------------------------------------------


@pytest.mark.parametrize("timeout", [None, 50.0])
def test_a_run_counts_as_many_cases_as_were_announced(
    protocol: Protocol, timeout: float | None
) -> None:
    options = Options(level="smoke", truncation_timeout=timeout)

    report = conform(grammar=protocol, options=options)

    assert len(report.results) == planned(protocol, options, select_cases(protocol, options))


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
        with handled(ignored, signal.SIG_IGN), conforming(robot.port, *words) as run:
            code, out, state = signalled_once_it_moves(run, robot, number)

    assert code == 3, out
    assert state["moving"] is False
    report = json.loads(file.read_bytes())
    assert report["exit"] == 3
    assert len({case["id"] for case in report["cases"]}) == len(report["cases"]) >= 35
    assert report["counts"]["inconclusive"] > 30
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

    assert code == json.loads(out)["exit"] == 1
    assert not device.state.moving


def test_a_run_that_nohup_started_goes_on_without_its_terminal() -> None:
    with simulate() as robot:
        few = ("--level", "smoke", "--only", "unused-id/9/*", "--json", "-")
        words = ("--probe", robot.probe, *few)
        with handled([signal.SIGHUP], signal.SIG_IGN), conforming(robot.port, *words) as run:
            code, out, _ = signalled_once_it_moves(run, robot, signal.SIGHUP)

    report = json.loads(out)
    assert code == report["exit"] != 1
    assert report["counts"]["pass"] > 10
    assert "interrupted" not in out


def test_a_recording_that_the_disk_cannot_take_ends_the_run_with_the_robot_at_rest(
    tmp_path: Path,
) -> None:
    """A file size limit stands for a full disk; SIGXFSZ is ignored, as Python does."""
    file = tmp_path / "run.mcap"
    with simulate() as served:
        result = process(
            *("conform", served.port, "--yes", "--probe", served.probe, "--level", "smoke"),
            *("--record", str(file)),
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (102_400, 102_400)),
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
    one, other = (
        json.loads(process(*words, "--json", "-", env={"PYTHONHASHSEED": seed}).stdout)
        for seed in "12"
    )

    assert one["cases"] == other["cases"]
    assert one["seed"] == 7


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
