"""The suite in real time, over TCP and a pty, gives the same verdicts as in virtual time."""

from __future__ import annotations

import re
import sys
import time
from pathlib import Path

import msgspec
import pytest

from benchmarks.noisy_device import NoisyDevice
from bilprov.analyzer.taps.relay import Noise
from bilprov.captures.reader import open_evidence
from bilprov.captures.schemas import MS
from bilprov.conformance.api import Options, conform, planned, select_cases
from bilprov.conformance.dut.simulator import Simulator
from bilprov.spec.protocol import Protocol
from tests.support.commands import command
from tests.support.robots import (
    TIMED_PROBES,
    Hidden,
    ProbeServer,
    judged_exit,
    sentence,
    served_here,
    simulate,
    simulated,
    unwell,
)

pytestmark = pytest.mark.waits

Verdicts = dict[str, str]


def judged(output: bytes) -> tuple[int, Verdicts]:
    """The exit code and the verdicts that a report tells."""
    report = msgspec.json.decode(output)
    verdicts = {case["id"]: case["verdict"] for case in report["cases"]}
    return report["exit"], verdicts


def judged_in_virtual_time(protocol: Protocol, fault: str, only: list[str]) -> tuple[int, Verdicts]:
    device = Hidden(simulated(protocol, fault))
    report = conform(device, grammar=protocol, options=Options(only=tuple(only)))
    return report.exit, {r.id: r.verdict.label for r in report.results}


# Standard takes some 70 s.
WHOLE = [pytest.mark.timeout(600), pytest.mark.sample(0)]


@pytest.mark.parametrize("level", ["smoke", pytest.param("standard", marks=WHOLE)])
def test_the_reference_conforms_in_real_time_with_nothing_inconclusive(
    protocol: Protocol, level: str
) -> None:
    options = Options(level=level)
    cases = select_cases(protocol, options)
    with simulate() as robot:
        words = ("conform", robot.port, "--probe", robot.probe, "--yes", "--json", "-")
        result = command(*words, "--level", level)
        state = robot.state()

    _, verdicts = judged(result.stdout)
    # Without a power switch there is no second power-on to begin with a motion.
    assert unwell(result) == {"power-on/Forward": "skipped"}
    assert {case.id for case in cases} < set(verdicts)
    count = planned(protocol, options, cases)
    assert f"{count:,} cases, ".encode() in result.stderr  # the estimate comes first
    assert state["moving"] is False


def test_a_line_that_holds_answers_back_is_told_with_what_that_takes(protocol: Protocol) -> None:
    robot = Simulator(protocol)
    late = NoisyDevice(robot, Noise(), 1, delay=8 * MS)  # in each direction
    late.probe = robot.probe  # type: ignore[attr-defined]  # what is served has a probe
    with served_here(late, pty=True) as (port, probe):
        result = command(
            *("conform", port, "--probe", probe, "--yes", "--level", "smoke"),
            *("--only", "valid/Stop", "--truncation-timeout", "50"),
        )

    told = rb"an answer takes (1[6-9]|[2-9]\d|\d\d\d) ms: the run takes about \d+ s more"
    assert re.search(told, result.stderr), result.stderr


def test_a_slow_probe_is_measured_and_counted_before_anybody_is_asked(protocol: Protocol) -> None:
    with (
        served_here(Simulator(protocol), pty=True) as (port, _),
        ProbeServer(b'{"moving": false}\n', delay=0.1) as probe,
    ):
        result = command("conform", port, "--probe", probe.name, "--level", "smoke")

    told = re.search(r"will move for about (\d+) s", sentence(result))
    assert told, result.stderr
    assert 80 < int(told[1]) < 400  # some thousand looks; a busy machine makes them longer


@pytest.mark.sample(1)
@pytest.mark.parametrize("patient", [False, True])
def test_a_recorded_run_tells_what_was_announced_unless_it_is_patient(
    patient: bool, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    with simulate() as robot:
        result = command(
            *("conform", robot.port, "--probe", robot.probe, "--yes", "--only", "valid/LED/1"),
            *("--record", str(path), *(["--patient"] if patient else [])),
        )

    run = msgspec.json.decode(open_evidence(str(path), ("run.json",)).attachments["run.json"])
    said = re.search(rb" cases, (\d+) s or more: ", result.stderr)
    assert said, result.stderr
    announced = run["circumstances"]["announced"]
    assert announced is None if patient else round(announced) == int(said[1])


# A fault for each way in which a run ends or time decides, and cases that catch it.
FAULTS = [
    ("", ["valid/LED/[07]", "truncated/LED/0", "recovery/*/Forward"], 0),
    ("wrong-code-for-unknown-id", ["unused-id/9/[0-4]"], 1),
    ("late-second-answer", ["wrong-length/LED/*"], 1),
    ("no-stop-on-bad-data", ["bad-data/LED/1?"], 1),
    ("restarts-by-itself", ["unused-id/9/[0-3]"], 1),
    ("never-times-out", ["truncated/LED/0"], 1),
    ("never-moves", ["unused-id/9/[0-3]"], 3),
    ("echo", ["valid/Stop"], 2),
    ("xon-xoff", ["valid/Speed/1[79]"], 1),
]

# An answer that comes after its exchange falls to one neighbour, to the other, or to the line
# between them, by microseconds.
EITHER = {"late-second-answer": ("reading/", "wrong-length/")}


@pytest.mark.sample(1)
@pytest.mark.parametrize(("fault", "only", "code"), FAULTS, ids=lambda value: str(value)[:30])
def test_a_fault_over_tcp_is_judged_as_in_virtual_time(
    protocol: Protocol, fault: str, only: list[str], code: int
) -> None:
    globs = [word for glob in only for word in ("--only", glob)]
    with simulate(*(["--fault", fault] if fault else [])) as robot:
        result = command(
            *("conform", robot.port, "--probe", robot.probe, "--yes", "--json", "-"), *globs
        )
        state = robot.state()

    ended, found = judged(result.stdout)
    assert result.returncode == ended, result.stderr
    assert judged_exit(ended, msgspec.json.decode(result.stdout)) == code
    virtual, expected = judged_in_virtual_time(protocol, fault, only)
    assert virtual == code
    # On a machine that is busy the link may be too coarse for a timing case, which then says so.
    unsure = ("informational", "inconclusive")
    timed = (*TIMED_PROBES, "timing/truncation-timeout")
    coarse = tuple(ident for ident in timed if found.get(ident) in unsure)
    either = ("line/", *EITHER.get(fault, ()), *coarse)
    assert {ident: found[ident] for ident in found if not ident.startswith(either)} == {
        ident: expected[ident] for ident in expected if not ident.startswith(either)
    }
    assert state["moving"] is False


class Switched(Simulator):
    """A simulator whose power goes off and on when a file appears, which it then takes away."""

    def __init__(self, protocol: Protocol, switch: Path) -> None:
        super().__init__(protocol)
        self._switch = switch
        self.cycles = 0

    def advance(self, now: int) -> bytes:
        if self._switch.exists():
            self.power_cycle(now)
            self.cycles += 1
            self._switch.unlink()
        return super().advance(now)

    def deadline(self) -> int:
        return min(super().deadline() or sys.maxsize, time.monotonic_ns() + 5_000_000)


def test_a_command_switches_the_power_off_and_on(protocol: Protocol, tmp_path: Path) -> None:
    switch = tmp_path / "switch"
    device = Switched(protocol, switch)
    with served_here(device) as (port, probe):
        power = f"exec:touch {switch}; while [ -e {switch} ]; do sleep 0.01; done"
        words = ("--probe", probe, "--power", power, "--yes", "--json", "-")
        result = command("conform", port, *words, "--level", "smoke")

    assert unwell(result) == {}  # nor is anything skipped
    assert device.cycles > 0


def test_a_power_switch_that_does_not_work_is_no_robot_s_fault() -> None:
    with simulate() as robot:
        words = ("--probe", robot.probe, "--power", "exec:exit 7", "--yes", "--level", "smoke")
        result = command("conform", robot.port, *words)
        state = robot.state()

    assert result.returncode == 2
    assert b"the power switch 'exit 7' did not work" in result.stdout
    assert state["moving"] is False


PROBE = """\
import json, socket, sys
with socket.create_connection(("127.0.0.1", {port})) as probe:
    probe.sendall(b"state\\n")
    moving = json.loads(probe.makefile().readline())["moving"]
print("moving" if moving else "stopped")
sys.exit(1 if moving else 0)
"""


# The cases of these that are looked at: each class in each motion comes first of its class.
@pytest.mark.sample(1)
@pytest.mark.parametrize(("fault", "code"), [("", 3), ("no-stop-while-forward", 1), ("echo", 2)])
def test_a_fault_over_a_pty_with_a_command_as_probe_is_judged_as_in_virtual_time(
    protocol: Protocol, tmp_path: Path, fault: str, code: int
) -> None:
    only, probe = "unused-id/9/[0-5]", tmp_path / "probe.py"
    with simulate(*(["--fault", fault] if fault else []), pty=True) as robot:
        probe.write_text(PROBE.format(port=robot.probe.rpartition(":")[2]))
        shell = f"exec:{sys.executable} -S -E {probe}"
        words = ("--probe", shell, "--yes", "--json", "-", "--only", only)
        result = command("conform", robot.port, *words)
        state = robot.state()

    found, verdicts = judged(result.stdout)
    assert result.returncode == found == code, result.stderr
    assert state["moving"] is False
    _, expected = judged_in_virtual_time(protocol, fault, [only])
    mine = {i for i, v in verdicts.items() if i.startswith("unused") and v in ("pass", "fail")}
    assert {i: verdicts[i] for i in mine} == {i: expected[i] for i in mine}
    assert mine or code == 2
