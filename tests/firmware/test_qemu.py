"""QEMU's monitor and a board under QEMU: what the probe shows, and what a power cycle clears."""

from __future__ import annotations

import json
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import wait_readable
from bilprov.captures.schemas import Look
from bilprov.conformance.dut.boards import EmulatorError
from bilprov.conformance.dut.boards.qemu import QemuBoard, running
from bilprov.conformance.dut.boards.qmp import Monitor
from bilprov.conformance.dut.port_link import PowerError
from bilprov.conformance.dut.probes import ProbeError
from bilprov.spec.protocol import Protocol
from tests.support.firmware import QEMU, built, emulator_of
from tests.support.robots import PATIENCE

pytestmark = pytest.mark.waits

# -- the monitor ----------------------------------------------------------------------------------


@pytest.fixture
def ends() -> Iterator[tuple[Monitor, socket.socket]]:
    """The kit's end of a monitor, and the emulator's."""
    mine, theirs = socket.socketpair()
    with theirs:
        monitor = Monitor(mine)
        yield monitor, theirs
        monitor.close()


def told(theirs: socket.socket, *replies: object) -> None:
    theirs.sendall(b"".join(json.dumps(reply).encode() + b"\r\n" for reply in replies))


def test_a_dump_is_its_bytes_whatever_events_come_before_it(
    ends: tuple[Monitor, socket.socket],
) -> None:
    monitor, theirs = ends
    text = "0000000020000000: 0x21 0x4c\r\n0000000020000002: 0x49 0x42\r\n"
    told(theirs, {"event": "RESET"}, {"event": "WATCHDOG"}, {"return": text})

    assert monitor.dump(0x20000000, 4) == b"!LIB"
    order = json.loads(theirs.recv(4096))
    assert order["arguments"] == {"command-line": "xp /4xb 0x20000000"}


def test_a_reply_in_pieces_is_waited_for(ends: tuple[Monitor, socket.socket]) -> None:
    monitor, theirs = ends
    monitor.ask_dump(0, 1)
    theirs.sendall(b'{"return": "0: 0x')
    assert monitor.take_dump() is None
    theirs.sendall(b'2a"}\n{"event"')
    assert monitor.take_dump() == b"*"


def test_an_emulator_that_has_gone_is_told(ends: tuple[Monitor, socket.socket]) -> None:
    monitor, theirs = ends
    theirs.close()

    with pytest.raises(EmulatorError, match="the emulator has ended"):
        monitor.greet()
    with pytest.raises(EmulatorError, match="the emulator has ended"):
        monitor.ask_dump(0, 1)


# -- a board --------------------------------------------------------------------------------------


class Bench:
    """A board that runs, with its line."""

    def __init__(self, port: Port, board: QemuBoard) -> None:
        self.port, self.board = port, board

    def send(self, data: bytes, *, answers: int = 1) -> bytes:
        self.port.write(data)
        heard = b""
        while len(heard) < answers:
            ready, _ = wait_readable([self.port], PATIENCE)
            assert ready, f"only {heard!r} came"
            heard += self.port.read()
        return heard

    def look(self) -> Look:
        self.board.ask()
        while (look := self.board.take(0)) is None:
            pass
        return look

    @property
    def process(self) -> int:
        emulator = emulator_of(os.getpid())
        assert emulator
        return emulator


@pytest.fixture
def bench(protocol: Protocol) -> Iterator[Bench]:
    with ExitStack() as stack:
        settings = line_settings(protocol, None, None, None)
        yield Bench(*stack.enter_context(running(built("-DAWAKE"), settings)))


@QEMU
def test_it_shows_what_the_robot_does_and_not_what_it_was_told(bench: Bench) -> None:
    assert bench.send(b"\x20") == b"\x00"
    assert (bench.look().moving, bench.look().motion) == (False, "stopped")  # it has no speed

    bench.send(b"\x11\x40")
    bench.send(b"\x41\xff")
    bench.send(b"\x81\x05")
    look = bench.look()
    assert (look.moving, look.motion, look.speed, look.steering) == (True, "forward", 64, 255)
    assert (look.left, look.right, look.led) == (64, 0, 5)


@QEMU
def test_with_its_power_goes_what_it_knew_and_what_it_had_not_read(bench: Bench) -> None:
    bench.send(b"\x11\x40")
    bench.send(b"\x20")
    os.kill(bench.process, signal.SIGSTOP)
    bench.port.write(b"\x90")  # would be answered 1

    bench.board.power_cycle()

    assert bench.look().moving is False
    assert bench.send(b"\x10\x20", answers=2) == b"\x04\x00"
    assert bench.look().moving is False


@QEMU
def test_a_board_that_does_not_start_again_is_a_broken_switch(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(bench.board, "_firmware", tmp_path / "gone.elf")

    with pytest.raises(PowerError, match="did not start again: qemu-system-avr ended: "):
        bench.board.power_cycle()


@QEMU
def test_a_robot_whose_state_is_overwritten_cannot_be_seen(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench.board, "_at", 0x800100 + 0x700)

    with pytest.raises(ProbeError, match="no longer holds the robot's state"):
        bench.look()
