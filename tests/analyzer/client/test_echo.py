"""Lines on which what is sent comes back: the echo is taken away, and a wrong one is told."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bilprov import Device, LinkError
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.replay.comparison import AnswerCheck
from bilprov.analyzer.simulated.device import SimulatedDevice
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.port import open_port
from bilprov.captures.schemas import MS, Chunk
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.report.json_report import read_report
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.commands import command
from tests.support.robots import PATIENCE, served_here

pytestmark = pytest.mark.waits


class Bus(SimulatedDevice):
    """A simulated device on a line that echoes what the host sends, or something else."""

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        self.echo: Callable[[bytes], bytes] = bytes
        self.delay = 0  # ns

    def receive(self, data: bytes, now: int) -> None:
        self._answers.append((now + self.delay, self.echo(data)))
        super().receive(data, now)


@pytest.mark.parametrize("pty", [True, False], ids=["pty", "TCP"])
def test_exactly_the_echo_is_taken_away(*, pty: bool) -> None:
    with (
        served_here(Bus(load_protocol("modbus-rtu")), pty=pty) as (port, _),
        Device(port, grammar="modbus-rtu", address=17, echo=True) as meter,
    ):
        # The answer to this request has the same bytes as its echo.
        assert meter.write_single_register(3, 9) == (3, 9)
        assert meter.write_single_register(4, 7, address=0) is None
        assert meter.read_holding_registers(3, 2) == (9, 7)


def test_pyserials_own_loop_is_a_line_with_an_echo() -> None:
    settings = line_settings(load_protocol("modbus-rtu"), echo=True)
    with open_port("loop://", settings) as port:
        port.write(bytes(range(200)))
        assert port.read() == b""


@pytest.fixture
def bus() -> Bus:
    return Bus(load_protocol("modbus-rtu"))


@pytest.fixture
def meter(bus: Bus) -> Iterator[Device]:
    """A client of the bus."""
    with (
        served_here(bus) as (port, _),
        Device(port, grammar="modbus-rtu", address=17, echo=True) as client,
    ):
        yield client


@pytest.mark.parametrize(
    ("echo", "came"),
    [
        (lambda _: b"", "11 03 02"),
        (lambda sent: sent[:4] + b"\xff", "11 03 00 03 ff"),
        (lambda sent: sent[:-1], "11 03 00 03 00 01 76 11"),
    ],
    ids=["no echo, but an answer", "a collision", "a byte is lost"],
)
def test_an_echo_that_differs_is_told_and_the_next_request_is_answered(
    bus: Bus, meter: Device, echo: Callable[[bytes], bytes], came: str
) -> None:
    bus.echo = echo
    with pytest.raises(LinkError) as raised:
        meter.read_holding_registers(3, 1)
    bus.echo = bytes
    assert meter.read_holding_registers(3, 1) == (0,)
    assert f" carried {came}" in str(raised.value)
    assert str(raised.value).endswith(
        " where 11 03 00 03 00 01 76 9a was sent: another sender talked at the same time, or this "
        "line has no echo"
    )


def test_an_echo_that_does_not_come_is_told(bus: Bus, meter: Device) -> None:
    bus.echo = lambda sent: sent[:3]
    with pytest.raises(LinkError, match=r"^3 of the 8 bytes 00 05 .* came back from .* in 0.5"):
        meter.write_single_coil(1, "on", address=0)


def test_a_wrong_echo_keeps_no_other_motor_from_being_stopped() -> None:
    bus = Bus(load_protocol("examples/roboclaw.py"))

    def driven() -> None:
        with Device(port, grammar="examples/roboclaw.py", address=0x80, echo=True) as motors:
            motors.forward_m1(50)
            motors.forward_m2(50)
            bus.echo = lambda sent: sent if sent[1] else b"\x00"

    with served_here(bus) as (port, _):
        with pytest.raises(LinkError, match="carried 00 "):
            driven()
        assert not bus.state(0x80).moving


DRIVING = """\
import sys
from bilprov import Device

with Device(sys.argv[1], grammar="examples/roboclaw.py", address=0x80, echo=True) as motors:
    motors.forward_m1(50)
    motors.forward_m2(50)
"""


def test_a_signal_within_an_echo_brings_the_device_to_rest() -> None:
    bus = Bus(load_protocol("examples/roboclaw.py"))
    moving = []

    def interrupted(sent: bytes) -> bytes:
        if sent[1:3] == bytes([4, 50]):  # the second motor
            moving.append(bus.state(0x80).moving)
            process.send_signal(signal.SIGINT)
        return sent

    bus.echo, bus.delay = interrupted, 30 * MS
    with (
        served_here(bus) as (port, _),
        subprocess.Popen(
            [sys.executable, "-c", DRIVING, port], cwd=ROOT, stderr=subprocess.PIPE
        ) as process,
    ):
        _, told = process.communicate(timeout=PATIENCE)
    assert moving == [True]
    assert not bus.state(0x80).moving
    assert b"KeyboardInterrupt" in told
    assert b"not brought to a stop" not in told


def test_commands_that_send_take_the_echo_away(tmp_path: Path) -> None:
    capture = tmp_path / "line.mcap"
    words = ("--grammar", "examples/relay_board.py")
    made = command(*words, "sniff", "sim", "--count", "4", "-w", str(capture))
    assert made.returncode == 0, made.stderr
    with served_here(Bus(load_protocol("examples/relay_board.py"))) as (port, _):
        again = command("replay", str(capture), "--to", port, "--echo", "--yes", "--rate", "0")
        sent = command(*words, "send", port, "On address=1", "--echo", "--yes")
        typed = command(*words, "send", port, "--echo", "--yes", stdin=b"On address=1\n")
        without = command(*words, "send", port, "On address=1", "--yes")
    for done in (sent, typed):
        assert (done.returncode, done.stderr) == (0, b"")
        assert done.stdout.count(b"\n") == 2
    assert again.returncode == 0, again.stderr
    assert b" sent, 0 differences\n" in again.stderr
    assert without.returncode == 1
    assert b"8 bytes came without an instruction; what was sent came back" in without.stderr


def test_an_answer_that_repeats_its_request_is_no_echo() -> None:
    """Modbus acknowledges a write so."""
    write = bytes.fromhex("11050003ff007eaa")
    check, session = AnswerCheck(), Session(load_protocol("modbus-rtu"))
    both = session.feed(Chunk(0, "host", write)) + session.feed(Chunk(MS, "device", write))
    for record in both + session.finish():
        check.record(record)
    assert (check.answered, check.echoed) == (1, False)


class EchoedCar(Simulator):
    """A conforming robot car on a line that echoes what the host sends."""

    def power_cycle(self, now: int) -> None:
        super().power_cycle(now)
        self.unechoed = b""

    def receive(self, data: bytes, now: int) -> None:
        self.unechoed += data
        super().receive(data, now)

    def deadline(self) -> int | None:
        return 0 if self.unechoed else super().deadline()

    def advance(self, now: int) -> bytes:
        echo, self.unechoed = self.unechoed, b""
        return echo + super().advance(now)


def test_a_robot_on_a_line_with_an_echo_is_judged_and_without_the_option_it_is_not() -> None:
    with served_here(EchoedCar(load_protocol())) as (port, probe):
        known = ("--level", "smoke", "--truncation-timeout", "50")
        words = ("conform", port, "--probe", probe, "--yes", "--only", "valid/Stop", *known)
        judged = command(*words, "--echo")
        without = command(*words)
    assert judged.returncode == 0, judged.stdout
    assert without.returncode == 2
    assert b"or an adapter that hears itself (--echo)" in without.stdout


def test_the_commands_that_repeat_a_case_have_the_options_of_the_line(tmp_path: Path) -> None:
    protocol, file = load_protocol(), tmp_path / "report.json"
    line = "--baud 9600 --stopbits 2 --echo"
    with served_here(EchoedCar(protocol, fault_bank(protocol)["ok-to-bad-data"])) as (port, probe):
        words = ("conform", port, "--probe", probe, "--yes", "--only", "bad-data/LED/8")
        known = ("--level", "smoke", "--truncation-timeout", "50", *line.split())
        told = command(*words, *known, "--verbose", "--json", str(file)).stdout.decode()
    assert read_report(str(file)).link["options"] == line
    assert f"bilprov send {port} {line} --probe {probe} " in told
    assert f"--probe {probe} {line}" in told
