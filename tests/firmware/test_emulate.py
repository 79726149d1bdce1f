"""`bilprov simulate --firmware`: firmware on a pty in real time, for any program to open."""

from __future__ import annotations

import json
import select
import signal
from itertools import pairwise
from pathlib import Path
from random import Random

import pytest
import serial

from bilprov.conformance.dut.boards.simavr import HELD, PacedBoard, SimavrBoard
from tests.support.commands import command
from tests.support.firmware import AVR, built, compiled
from tests.support.robots import BYTE_TIME, MS, PATIENCE, emulate

pytestmark = pytest.mark.waits


FIRMWARE = Path(__file__).with_name("echo.c").read_text(encoding="utf-8")


def echo(switch: str = "NONE") -> Path:
    """Firmware that sends each byte back, at 115,200 baud; or not always, as the switch says."""
    return compiled(FIRMWARE, f"-D{switch}")


# -- in virtual time ------------------------------------------------------------------------------


class Paced:
    """A paced board on a clock that the test moves: what arrives from it, and when (ns)."""

    def __init__(self, firmware: Path) -> None:
        self.said: list[str] = []
        self.device = PacedBoard(SimavrBoard(firmware), BYTE_TIME, self.said.append)
        self.now = 0
        self.heard: list[tuple[int, int]] = []
        self.wait(5 * MS)

    @property
    def answers(self) -> bytes:
        return bytes(byte for _, byte in self.heard)

    def send(self, data: bytes) -> None:
        self.device.receive(data, self.now)

    def wait(self, duration: int, *, step: int | None = None) -> None:
        """Let time pass as the device wants it, or in steps (ns) of one's own."""
        until = self.now + duration
        while self.now < until:
            due = self.device.deadline() if step is None else self.now + step
            self.now = until if due is None else min(until, max(due, self.now + 1))
            self.heard += [(self.now, byte) for byte in self.device.advance(self.now)]


@pytest.mark.sample(2)
@AVR
@pytest.mark.parametrize("step", [None, 7 * MS, 19 * MS], ids=["as wanted", "late", "very late"])
@pytest.mark.parametrize(
    "switch", ["NONE", "DOUBLE_SPEED", "DOUBLED_LATER", "TWO_STOP_BITS", "READS_LATE"]
)
def test_no_byte_of_a_long_burst_is_lost(switch: str, step: int | None) -> None:
    line = Paced(echo(switch))
    data = Random(1).randbytes(4096)

    line.send(data)
    line.wait(900 * MS, step=step)

    assert line.answers == data


@AVR
def test_bytes_take_their_time_on_the_wire_both_ways() -> None:
    line = Paced(echo())
    sent = line.now
    line.send(bytes(50))
    line.wait(20 * MS)
    times = [at for at, _ in line.heard]

    assert len(times) == 50
    assert all(at >= sent + (count + 1) * BYTE_TIME for count, at in enumerate(times, 1))
    assert all(later - at >= BYTE_TIME for at, later in pairwise(times))
    assert times[0] < sent + 4 * BYTE_TIME  # and not much longer


@AVR
def test_a_machine_that_was_busy_skips_no_time() -> None:
    prompt, late = Paced(built()), Paced(built())
    for line, step in ((prompt, None), (late, 10 * MS)):
        line.send(b"\x11\xff\x20")
        line.wait(5 * MS)
        line.send(b"\x81")  # is cut short after 50 ms
        line.wait(100 * MS, step=step)

    assert prompt.answers == late.answers == b"\x00\x00\x04"
    assert late.heard[-1][0] - prompt.heard[-1][0] <= 10 * MS


@AVR
def test_a_probe_sees_the_stop_that_is_due_however_late_the_board_is() -> None:
    line = Paced(built())
    line.send(b"\x11\xff\x20")
    line.wait(5 * MS)
    line.send(b"\x81")  # is cut short after 50 ms
    line.now += 200 * MS  # as if others had used the machine

    assert b'"moving":false' in line.device.probe(line.now)


@AVR
def test_after_a_long_stop_it_catches_up_bit_by_bit() -> None:
    line = Paced(built())
    line.send(b"\x11\xff\x20")
    line.now += 500 * MS  # as if it had been suspended

    turns = 0
    while (due := line.device.deadline()) is not None and due <= line.now:
        line.heard += [(line.now, byte) for byte in line.device.advance(line.now)]
        turns += 1

    assert line.answers == b"\x00\x00"
    assert turns >= 10  # so that Ctrl-C is heard meanwhile


@AVR
def test_firmware_that_reads_no_more_loses_bytes_and_holds_up_nobody() -> None:
    line = Paced(echo("HANGS"))
    line.send(bytes(500))
    line.wait(300 * MS)
    assert line.answers == b"\x00"

    line.wait(50 * MS)
    due = line.device.deadline()

    assert due is not None
    assert due - line.now >= MS  # nothing waits any more
    assert line.said == []


@AVR
def test_a_flood_is_cut_and_said_once() -> None:
    line = Paced(echo())
    for _ in range(3):
        line.send(bytes(HELD // 2 + 1))

    assert len(line.said) == 1
    assert f"{HELD} bytes wait" in line.said[0]


@AVR
@pytest.mark.parametrize("busy", [0, 3 * MS], ids=["prompt", "busy"])
@pytest.mark.parametrize("switch", ["SLEEPS_FOR_EVER", "RUNS_OFF"])
def test_a_crash_is_said_once_and_its_last_answer_still_arrives(switch: str, busy: int) -> None:
    line = Paced(echo(switch))
    line.send(b"a")
    line.now += busy
    line.send(b"bc")
    line.wait(50 * MS)

    assert line.device.crashed
    assert line.answers == b"a"
    assert len(line.said) == 1
    assert line.said[0].startswith("the firmware crashed 0.005 s after its start")
    assert line.device.deadline() is None
    line.send(b"d")
    line.wait(50 * MS)
    assert line.answers == b"a"
    assert line.device.deadline() is None
    assert json.loads(line.device.probe(line.now))["led"] == 5


# -- the command ----------------------------------------------------------------------------------


LOOK = ("moving", "motion", "led", "left", "right")


@AVR
def test_firmware_that_crashed_stays_served_and_ends_with_2() -> None:
    with emulate(echo("RUNS_OFF")) as served:
        assert served.process.stderr is not None
        with serial.Serial(served.port, 115200, timeout=PATIENCE) as port:
            port.write(b"abc")
            assert port.read(1) == b"a"
            ready, _, _ = select.select([served.process.stderr], [], [], PATIENCE)
            assert ready, "nobody is told"
            told = served.process.stderr.readline()
            port.write(b"d")
            drives_on = (True, "forward", 5, 255, 0)  # as a robot would
            assert served.state() == dict(zip(LOOK, drives_on, strict=True))
            assert port.in_waiting == 0
        served.process.send_signal(signal.SIGINT)
        out, err = served.process.communicate(timeout=PATIENCE)

    assert told.startswith(b"the firmware crashed ")
    assert (served.process.returncode, out, err) == (2, b"", b"")


@AVR
def test_the_wire_has_the_baud_of_the_grammar(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, grammar_text: str
) -> None:
    slow = tmp_path / "slow.py"
    slow.write_text(grammar_text.replace("baud=115200", "baud=9600"))
    times: list[int] = []

    def served(device: PacedBoard, **_: object) -> None:
        """Stands for the clock, the pty and who opens it."""
        device.receive(b"a", 0)
        while not device.advance(due := device.deadline() or 0):
            pass
        times.append(due)

    monkeypatch.setattr("bilprov.conformance.cli.simulate.serve", served)
    for words in ([], ["--grammar", str(slow)]):
        command(*words, "simulate", "--firmware", str(echo()))

    assert times[1] - times[0] >= 900_000
