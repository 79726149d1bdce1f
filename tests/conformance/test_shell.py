"""`bilprov send PORT`: what is typed is done, and every way out leaves the robot at rest."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import MS
from bilprov.conformance.cli.shell.prompt import candidates
from bilprov.conformance.dut.simulator import Simulator
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.commands import command
from tests.support.robots import PATIENCE, ProbeServer, sentence, served_here, until
from tests.support.terminals import (
    CONTINUE,
    CTRL_C,
    CTRL_D,
    CTRL_Z,
    TAB,
    UP,
    Terminal,
    as_job,
    on_terminal,
)

pytestmark = pytest.mark.waits

SAYS_MORE = b"\x81\x07"


class Car(Simulator):
    """A simulated robot that notes what it hears; after LED 7 it says `more` unasked.

    More than a few bytes it says again and again.
    """

    def __init__(self, protocol: Protocol, more: bytes = b"") -> None:
        super().__init__(protocol)
        self.heard = b""
        self.said = 0
        self._more = more
        self._again: int | None = None

    def receive(self, data: bytes, now: int) -> None:
        self.heard += data
        if SAYS_MORE in data and self._more:
            self._again = now + 20 * MS
        super().receive(data, now)

    def advance(self, now: int) -> bytes:
        more = b""
        if self._again is not None and now >= self._again:
            more, self._again = self._more, now + 2 * MS if len(self._more) > 8 else None
        self.said += len(more)
        return super().advance(now) + more

    def deadline(self) -> int | None:
        due = [t for t in (super().deadline(), self._again) if t is not None]
        return min(due, default=None)


@contextmanager
def car(protocol: Protocol, more: bytes = b"") -> Iterator[tuple[Car, str, str]]:
    """A car on a pty; with the names of its port and its probe."""
    device = Car(protocol, more)
    with served_here(device, pty=True) as (port, probe):
        yield device, port, probe


@contextmanager
def prompted(
    protocol: Protocol, *words: str, more: bytes = b"", **variables: str
) -> Iterator[tuple[Car, Terminal]]:
    """A car, and the terminal at whose prompt it is driven."""
    with (
        car(protocol, more) as (device, port, _),
        on_terminal("send", port, "--yes", *words, **variables) as terminal,
    ):
        yield device, terminal


# -- lines from a pipe ----------------------------------------------------------------------------


def test_a_line_that_is_too_long_ends_it_and_is_told(protocol: Protocol) -> None:
    with car(protocol) as (device, port, _):
        lines = "Speed 80\n" + "81 05 " * 20_000
        result = command("send", port, "--yes", stdin=lines.encode())

    assert result.returncode == 2
    assert "a line is longer than 65536 bytes" in sentence(result)
    assert device.heard.strip(b"\x00") == b"\x11\x50"


# -- limits ---------------------------------------------------------------------------------------


def test_a_device_that_floods_the_line_is_stopped_and_fills_neither_screen_nor_memory(
    protocol: Protocol,
) -> None:
    with car(protocol, more=b"\x00" * 1000) as (device, port, _):
        process = subprocess.Popen(
            [sys.executable, "-m", "bilprov", "send", port, "--yes"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=ROOT,
        )
        with process:
            assert process.stdin is not None
            process.stdin.write(b"Forward; LED 7; pause=60000; Speed 1\n")
            process.stdin.flush()
            until(lambda: device.said > 100_000)
            early = _resident(process.pid)
            until(lambda: device.said > 500_000)
            grown = _resident(process.pid) - early
            out, err = process.communicate(timeout=PATIENCE)

    assert process.returncode == 1
    assert grown < 40_000_000  # one record kept for each byte is four times that
    assert err.decode().count("floods the line: 64 bytes came that answer no instruction") == 1
    assert "bytes came without an instruction" in err.decode()
    assert len(out.splitlines()) < 100
    assert not device.state.moving
    assert device.state.speed == 0


def _resident(process: int) -> int:
    """Bytes of memory that a process holds."""
    pages = Path(f"/proc/{process}/statm").read_text().split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


# -- on a terminal --------------------------------------------------------------------------------


def driving(terminal: Terminal, device: Car) -> None:
    """Type what makes the robot drive, and see that it does."""
    terminal.wait_for("led 0>")
    terminal.type("Speed 80; Forward\r")
    terminal.wait_for("forward speed 80 led 0>")
    assert device.state.moving


def _signal(number: signal.Signals) -> Callable[[Terminal], None]:
    return lambda terminal: terminal.process.send_signal(number)


WAYS_OUT: dict[str, Callable[[Terminal], None]] = {
    "Ctrl-D": lambda terminal: terminal.type(CTRL_D),
    "quit": lambda terminal: terminal.type("quit\r"),
    "exit": lambda terminal: terminal.type("exit\r"),
    "Ctrl-C twice": lambda terminal: terminal.type(CTRL_C + CTRL_C),
    "Ctrl-\\": lambda terminal: terminal.type("\x1c"),
    "SIGTERM": _signal(signal.SIGTERM),
    "SIGHUP": _signal(signal.SIGHUP),
    "hang-up": lambda terminal: terminal.hang_up(),
    "in a pause, SIGTERM": lambda terminal: (
        terminal.type("pause=60000\r"),
        _signal(signal.SIGTERM)(terminal),
    ),
}


@pytest.mark.sample(4)
@pytest.mark.parametrize("way", WAYS_OUT)
def test_every_way_out_leaves_the_robot_at_rest(protocol: Protocol, way: str) -> None:
    with prompted(protocol) as (device, terminal):
        driving(terminal, device)
        WAYS_OUT[way](terminal)
        code = terminal.end()

        # After a hang-up nobody saw the end; a shell reports SIGQUIT as 131.
        assert code == {"hang-up": 2, "Ctrl-\\": 131}.get(way, 0), terminal.shown
        assert not device.state.moving
        assert "Traceback" not in terminal.shown


def test_ctrl_c_ends_a_pause_and_stops_the_robot_and_the_shell_goes_on(protocol: Protocol) -> None:
    with car(protocol) as (device, port, probe):
        with on_terminal("send", port, "--yes", "--probe", probe) as terminal:
            terminal.wait_for("led 0, seen stopped>")
            terminal.type("Speed 80; Forward; look; pause=60000; Speed 1\r")
            terminal.wait_for("seen moving: motion forward")
            terminal.type(CTRL_C)
            terminal.wait_for("stopped: Ctrl-C")
            terminal.wait_for("stopped speed 80 led 0, seen stopped>")
            assert (device.state.moving, device.state.speed) == (False, 80)
            terminal.type("LED 5\r")
            terminal.wait_for("stopped speed 80 led 5, seen stopped>")
            # At the prompt it stops the robot too, takes back what is typed, and then leaves.
            terminal.type("Forward\r")
            terminal.wait_for("seen moving>")
            terminal.type(CTRL_C)
            terminal.wait_for("stopped: Ctrl-C")
            terminal.wait_for("seen stopped>")
            terminal.type("half a li" + CTRL_C + "state\r")
            terminal.wait_for("predicted: ")
            terminal.wait_for("seen stopped>")
            assert terminal.end(CTRL_C) == 0

        assert device.state.speed == 80


SHELL = ("-m", "bilprov", "send", "--yes")


@pytest.mark.parametrize("line", ["", "LED 5; pause=60000; Speed 1"])
def test_ctrl_z_stops_the_robot_and_then_suspends_and_the_shell_goes_on(
    protocol: Protocol, line: str
) -> None:
    with car(protocol) as (device, port, _), as_job(*SHELL, port) as terminal:
        driving(terminal, device)
        if line:
            terminal.type(f"{line}\r")
            until(lambda: device.state.led == 5)
        terminal.type(CTRL_Z)
        terminal.wait_for("Stopped")
        until(lambda: not device.state.moving)
        terminal.type(CONTINUE)
        terminal.wait_for("stopped: the program was suspended")
        terminal.wait_for("stopped speed 80 led")
        terminal.type("LED 7\r")
        terminal.wait_for("← 00")
        terminal.wait_for("stopped speed 80 led 7>")
        terminal.type(CTRL_D)
        terminal.wait_for("ended with 0")
        assert device.state.speed == 80


ROBOT = """
import sys
from bilprov.analyzer.client.robot import Robot
with Robot(sys.argv[1]) as robot:
    robot.speed(80)
    robot.forward()
    robot.wait(60_000)
"""


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("words", "after", "told"),
    [
        (
            ("-m", "bilprov", "send"),
            ("Speed 80", "Forward", "pause=60000", "Stop", "--yes"),
            "ended with 1",
        ),
        (("-m", "bilprov", "conform"), ("--level", "smoke", "--yes"), "ended with 3"),
        (("-m", "bilprov", "lab", "learn"), ("--yes",), "ended with 3"),
        (("-c", ROBOT), (), "ended with 1"),
    ],
)
def test_ctrl_z_stops_the_robot_before_any_program_that_drives_it_is_suspended(
    protocol: Protocol, words: tuple[str, ...], after: tuple[str, ...], told: str
) -> None:
    with car(protocol) as (device, port, _), as_job(*words, port, *after) as terminal:
        until(lambda: device.state.moving)
        terminal.type(CTRL_Z)
        terminal.wait_for("Stopped")
        until(lambda: not device.state.moving)
        terminal.type(CONTINUE)
        terminal.wait_for("the program was suspended")
        terminal.wait_for(told)
        assert "came without an instruction" not in terminal.shown
        assert not device.state.moving


def test_at_the_prompt_unasked_bytes_are_shown_and_a_long_drive_is_ended(
    protocol: Protocol,
) -> None:
    with prompted(protocol, "--max-drive", "0.5", more=b"\x05") as (device, terminal):
        driving(terminal, device)
        terminal.type("LED 7\rtyped mean")
        terminal.wait_for("no instruction waits for an answer")
        terminal.wait_for("stopped: it has driven for 0.5 s without a new instruction")
        terminal.wait_for("stopped speed 80 led 7> typed mean")
        assert not device.state.moving
        assert terminal.end(CTRL_C + CTRL_D) == 0


def test_what_fails_while_it_drives_is_told_in_one_sentence(protocol: Protocol) -> None:
    answers = (b'{"moving": false}\n', b'{"moving": true}\n', b"")
    with ProbeServer(*answers) as probe, car(protocol) as (device, port, _):
        with on_terminal("send", port, "--yes", "--probe", probe.name) as terminal:
            terminal.wait_for("seen stopped>")
            terminal.type("Speed 80; Forward\r")
            terminal.wait_for("seen moving>")
            assert terminal.end("LED 5\r") == 2  # here the probe hangs up

        assert f"bilprov: the probe at {probe.name} hung up" in terminal.shown
        assert "Traceback" not in terminal.shown
        assert not device.state.moving


def test_a_port_that_is_unplugged_at_the_prompt_is_told_in_one_sentence(protocol: Protocol) -> None:
    with ExitStack() as stack:
        with car(protocol) as (device, port, _):
            terminal = stack.enter_context(on_terminal("send", port, "--yes"))
            driving(terminal, device)
        assert terminal.end() == 2
    assert terminal.shown.count(f"bilprov: {port} disappeared while it was in use") == 1
    assert "Traceback" not in terminal.shown


def test_tab_completes_and_the_arrows_recall_lines(protocol: Protocol) -> None:
    with prompted(protocol) as (device, terminal):
        terminal.wait_for("led 0>")
        for typed, shown in [("led", "LED"), (" ", "rgb="), ("5; rotater", "RotateRight")]:
            terminal.type(typed + TAB)
            terminal.wait_for(shown)
        terminal.type("\r")
        terminal.wait_for("rotate_right speed 0 led 5>")
        terminal.type("stop; LED 0\r")
        terminal.wait_for("stopped speed 0 led 0>")
        terminal.type(f"{UP}{UP}\r")
        terminal.wait_for("rotate_right speed 0 led 5>")
        assert terminal.end(CTRL_D) == 0

    assert device.heard.strip(b"\x00") == b"\x81\x05\x60\x00\x81\x00\x81\x05\x60"


def test_on_a_terminal_without_a_cursor_it_is_plain_and_a_mistake_ends_nothing(
    protocol: Protocol,
) -> None:
    with prompted(protocol, TERM="dumb") as (_, terminal):
        terminal.type("Speeed 1\nSpeed 9\nstate\nquit\n")
        terminal.wait_for("Speed?; see help")
        terminal.wait_for("predicted: stopped speed 9")
        assert terminal.end() == 0


# -- completion -----------------------------------------------------------------------------------


def test_each_instruction_and_field_of_the_grammar_completes(each_protocol: Protocol) -> None:
    def texts(line: str) -> list[str]:
        offered = candidates(each_protocol, {}, line)
        return [line[: len(line) + one.start_position] + one.text for one in offered]

    for spec in each_protocol.instructions:
        assert spec.name in texts("")
        assert f"81 05; {spec.name}" in texts(f"81 05; {spec.name[:2].lower()}")
        line = f"{spec.name} "
        for part in spec.fields:
            assert f"{line}{part.name}=" in texts(line)
            assert texts(f"{line}{part.name[:1]}")
            line += f"{part.name}={part.low} "
        assert texts(line) == []


def test_words_and_pauses_complete_and_an_instruction_goes_before_a_word(
    protocol: Protocol,
) -> None:
    words = {"stop": "a word", "home": "another"}
    found = {one.text: one.display_meta_text for one in candidates(protocol, words, "Forward; ")}

    assert found["home"] == "another"
    assert "stop" not in found
    assert found["Stop"] == protocol.by_name["Stop"].prose
    assert [one.text for one in candidates(protocol, words, "pa")] == ["pause="]
    assert list(candidates(protocol, words, "81 ")) == []


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("WriteSingleC", ["WriteSingleCoil"]),
        ("WriteSingleCoil ", ["coil=", "value=", "address="]),
        ("WriteSingleCoil value=", []),
    ],
)
def test_fields_and_the_address_are_completed(typed: str, offered: list[str]) -> None:
    found = candidates(load_protocol("modbus-rtu"), {}, typed)
    assert [one.text for one in found] == offered
