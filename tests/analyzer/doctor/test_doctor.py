"""The doctor: what it finds on made-up machines, in traffic, by asking, and on real lines."""

from __future__ import annotations

import json
import os
import pwd
import random
import shlex
import shutil
import socket
import subprocess
import termios
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from bilprov.analyzer.client.operations import Listen, Operation, Received, Send
from bilprov.analyzer.doctor.examination import (
    RATES,
    Reply,
    Subject,
    asked,
    examined,
    heard,
    notes,
    of_line,
    rates_of,
    subject,
    told,
)
from bilprov.analyzer.doctor.finding import Finding, Grade, usable
from bilprov.analyzer.transport.errors import NO_BRAILLE, LinkError, denied
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.machine import Held, Machine
from bilprov.analyzer.transport.port import PtyPair, open_pty
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import Chunk, Direction, Line
from bilprov.conformance.dut.simulator import Simulator
from bilprov.spec.protocol import Protocol
from tests.support.attaching import Talk, attached
from tests.support.commands import command
from tests.support.machines import FakeMachine
from tests.support.wires import PtyRobot, running, served

PORT = "/dev/ttyUSB0"
MM_IGNORED = "E:ID_MM_DEVICE_IGNORE=1\n"
BRAILLE = "E:BRLTTY_BRAILLE_DRIVER=bm\n"


@pytest.fixture
def machine(tmp_path: Path) -> FakeMachine:
    return FakeMachine(tmp_path)


def findings(machine: Machine, name: str) -> dict[str, Finding]:
    return {one.check: one for one in examined(subject(name, machine, ["/dev/ttyUSB0"]))}


# The system


def test_a_quiet_adapter_is_fine_in_every_way(machine: FakeMachine) -> None:
    port = machine.adapter(latency=1)
    assert {one.grade for one in findings(machine, port).values()} == {Grade.FINE}
    assert notes(port, machine) == []


def test_an_adapter_that_brltty_has_taken_explains_the_missing_port(machine: FakeMachine) -> None:
    machine.adapter("", "1a86:7523", title="USB Serial", usb_udev=BRAILLE)
    missing = findings(machine, PORT)["there"]
    assert missing.grade is Grade.BLOCKS
    assert "brltty" not in missing.sentence
    assert missing.sentence.endswith("did you mean /dev/ttyUSB0?")
    machine.run(42, "brltty")
    found = findings(machine, PORT)["there"]
    assert "brltty has taken the adapter 1a86:7523 USB Serial" in found.sentence
    assert found.command == "sudo systemctl mask --now brltty.service brltty-udev.service"


@pytest.mark.parametrize("name", ["/dev/null", "/dev"])
def test_what_is_no_serial_port_is_looked_at_no_further(name: str) -> None:
    *_, found = findings(Machine(), name).values()
    assert (found.check, found.grade) == ("serial port", Grade.BLOCKS)
    assert "not a serial port" in found.sentence


@pytest.mark.parametrize(
    ("holder", "ends"),
    [
        ("minicom", "kill 42"),
        ("ModemManager", "sudo systemctl stop ModemManager.service"),  # it would be started anew
        ("agetty", "sudo systemctl stop serial-getty@ttyUSB0.service"),
    ],
)
def test_a_holder_is_named_with_the_kindest_way_to_end_it(
    machine: FakeMachine, holder: str, ends: str
) -> None:
    machine.run(42, holder, machine.adapter())
    found = findings(machine, PORT)["holder"]
    assert (found.grade, found.command) == (Grade.BLOCKS, ends)
    assert found.sentence.startswith(f"{PORT} is in use by another program, {holder} (pid 42);")


SET_LATENCY = "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer"


@pytest.mark.parametrize(
    ("check", "options", "mends"),
    [
        ("brltty", {"usb_udev": BRAILLE}, NO_BRAILLE),
        ("latency timer", {"latency": 16}, SET_LATENCY),
    ],
)
def test_what_is_worth_a_word_is_found_alone_with_the_command_that_mends_it(
    machine: FakeMachine, check: str, options: dict[str, Any], mends: str
) -> None:
    port = machine.adapter(**({"latency": 1} | options))
    (found,) = [one for one in findings(machine, port).values() if one.grade is not Grade.FINE]
    assert (found.check, found.grade, found.command) == (check, Grade.ADVICE, mends)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to another group")
def test_who_has_joined_the_group_has_to_log_in_again(machine: FakeMachine) -> None:
    port = machine.adapter()
    shutil.chown(machine.file(port), group="dialout")
    assert denied(port, machine).command == "sudo usermod -aG dialout $USER"
    user = pwd.getpwuid(os.geteuid()).pw_name
    machine.write("/etc/group", f"tty:x:5:{user}\ndialout:x:20:other,{user}\n")
    assert denied(port, machine).command == "newgrp dialout"


@pytest.mark.parametrize(("count", "words"), [(1, "1 process is"), (2, "2 processes are")])
def test_processes_that_cannot_be_looked_into_are_no_verdict(
    machine: FakeMachine, count: int, words: str
) -> None:
    port = Subject(machine.adapter(), machine, (), Held(unseen=count))
    (found,) = [one for one in examined(port) if one.check == "holder"]
    assert found.grade is Grade.UNSEEN
    assert f"; {words} other users' and cannot be looked into" in found.sentence
    assert found.command == "sudo fuser -v /dev/ttyUSB0"


def test_modem_manager_is_told_unless_it_has_to_leave_the_adapter_alone(
    machine: FakeMachine,
) -> None:
    port = machine.adapter()
    assert findings(machine, port)["ModemManager"].grade is Grade.FINE
    machine.run(42, "ModemManager")
    found = findings(machine, port)["ModemManager"]
    assert found.grade is Grade.ADVICE
    written = shlex.split(found.command)[1]
    assert written == (
        'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6001", ENV{ID_MM_DEVICE_IGNORE}="1"'
    )
    for file in ("c188:0", "c189:4"):  # a rule may tag the port or its USB device
        machine.write("/run/udev/data/c188:0")
        machine.write(f"/run/udev/data/{file}", MM_IGNORED)
        assert findings(machine, port)["ModemManager"].grade is Grade.FINE


def test_a_command_that_uses_a_port_is_told_in_a_line_each(machine: FakeMachine) -> None:
    port = machine.adapter()
    machine.run(42, "ModemManager")
    machine.run(43, "cat", port)
    shared, modem, latency = notes(port, machine)
    assert shared.endswith("since each of the two loses what the other reads: kill 43")
    assert modem.endswith(": `bilprov ports /dev/ttyUSB0` prints the command")
    assert latency.endswith(f": {SET_LATENCY}")
    assert notes("socket://127.0.0.1:5000") == notes("loop://") == []


# Listening

NAMES = {"host": "/dev/ttyUSB0", "device": "/dev/ttyUSB1"}
TURNED = {"host": "device", "device": "host"}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("talk", [Talk(), Talk(pipelined=True), Talk(timers=True)])
def test_swapped_taps_are_told_from_straight_ones(
    each_protocol: Protocol, talk: Talk, seed: int
) -> None:
    events = attached(each_protocol, talk, random.Random(seed)).events
    (straight,) = heard(each_protocol, NAMES, events, 2)
    assert (straight.check, straight.grade) == ("taps", Grade.FINE)
    swapped = [Chunk(event.t, TURNED[event.direction], event.data) for event in events]  # type: ignore[arg-type]
    (found,) = heard(each_protocol, NAMES, swapped, 2)
    assert found.grade is Grade.BLOCKS
    assert found.sentence.startswith("the taps are swapped")
    assert found.command == "bilprov sniff /dev/ttyUSB1 /dev/ttyUSB0"


def test_answers_that_fit_neither_way_round_are_not_laid_to_the_taps(protocol: Protocol) -> None:
    events = attached(protocol, Talk(), random.Random(1)).events
    odd = [Chunk(one.t, one.direction, bytes(byte ^ 0xA5 for byte in one.data)) for one in events]
    (found,) = heard(protocol, NAMES, odd, 2)
    assert found.grade is Grade.ADVICE
    assert "either way round" in found.sentence


WIRE = [(n, side, b"\x11\x50\x20") for n in range(3) for side in ("host", "device")]
ALIKE = [(n * 10_000_000, side, b"\0") for n in range(9) for side in ("device", "host")]


@pytest.mark.parametrize(
    ("chunks", "grade", "sentence"),
    [
        ([], Grade.UNSEEN, "not a byte was heard in 2 s: a device speaks only when it is asked"),
        (WIRE, Grade.BLOCKS, "both taps hear the same bytes: they are on one wire, or the line is"),
        (
            [(0, "host", b"\x00Hello from U-Boot\r\n")],
            Grade.ADVICE,
            "protocol: 'Hello from U-Boot'",
        ),
        *(
            ([(0, "host", bytes.fromhex(frame) * 20)], Grade.FINE, "came in 2 s")
            for frame in ("20", "41 0a", "20 30", "41 41 51 42")  # which look like text
        ),
    ],
)
def test_what_is_heard_is_told_in_a_sentence(
    protocol: Protocol, chunks: list[tuple[int, Direction, bytes]], grade: Grade, sentence: str
) -> None:
    names = {side: NAMES[side] for side in NAMES if side == "host" or len(chunks) > 1}
    (found,) = heard(protocol, names, [Chunk(*chunk) for chunk in chunks], 2)
    assert found.grade is grade
    assert sentence in found.sentence


def test_stops_and_their_answers_are_alike_so_nothing_is_said_of_the_taps(
    protocol: Protocol,
) -> None:
    assert usable(heard(protocol, NAMES, [Chunk(*chunk) for chunk in ALIKE], 2))


def test_framing_errors_mean_another_baud_rate(protocol: Protocol) -> None:
    events = [Chunk(0, "host", b"\xf8\x00"), Line(1, "framing", "host", "2 counted by the driver")]
    found, _ = heard(protocol, {"host": PORT}, events, 2)
    assert found.grade is Grade.BLOCKS
    assert found.sentence.startswith("the driver counted 2 framing errors in 2 bytes")
    assert found.command == "bilprov ports /dev/ttyUSB0 --ask --yes"


@pytest.mark.waits
def test_a_server_that_hangs_up_is_told_with_its_last_words(protocol: Protocol) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener, Stopper() as stopper:
        name = f"socket://127.0.0.1:{listener.getsockname()[1]}"
        found = of_line(protocol, [name], line_settings(protocol), 30, stopper)
        assert next(found).check == "opening"  # what comes before that is thrown away
        with listener.accept()[0] as peer:
            peer.sendall(b"Port already in use\r\n")
        lost, *_ = found
    assert lost.grade is Grade.BLOCKS
    assert lost.sentence.startswith(f"it sent 'Port already in use', then {name} was closed")


# Asking


class Line8N1:
    """A wire to a simulated device that is set to one baud rate, in virtual time.

    At other rates either side hears what `garble` makes of the bytes.
    """

    def __init__(self, device: Simulator, baud: int, garble: Callable[[bytes], bytes]) -> None:
        self.baud = self.tuned = baud
        self.said: list[tuple[int, bytes]] = []
        self._device, self._garble = device, garble
        self._now = 0

    def tune(self, baud: int) -> None:
        if baud == 250000:
            raise LinkError("no such rate")
        self.tuned = baud

    def do(self, operation: Operation) -> int | Received:
        if isinstance(operation, Send):
            self.said.append((self.tuned, operation.data))
            self._device.receive(self._passed(operation.data), self._now)
            return self._now
        assert isinstance(operation, Listen)
        return self._listen(operation.count, self._now + operation.patience)

    def _listen(self, count: int | None, until: int) -> Received:
        came = list[tuple[int, int]]()
        while count is None or len(came) < count:
            due = self._device.deadline()
            if due is None or due > until:
                self._now = until
                break
            self._now = max(self._now, due)
            answers = self._passed(self._device.advance(self._now))
            came += [(self._now, byte) for byte in answers]
        return Received(tuple(came), self._now)

    def _passed(self, data: bytes) -> bytes:
        return data if self.tuned == self.baud else self._garble(data)


GARBLES: list[Callable[[bytes], bytes]] = [
    lambda data: b"",
    lambda data: bytes(byte ^ 0xE6 for byte in data),
    lambda data: bytes(2 * len(data)),
]


@pytest.mark.parametrize("garble", GARBLES, ids=["nothing", "bits", "zeros"])
@pytest.mark.parametrize("baud", [9600, 57600, 115200])
def test_the_rate_at_which_a_device_answers_is_found_and_the_device_homed(
    each_protocol: Protocol, baud: int, garble: Callable[[bytes], bytes]
) -> None:
    device = Simulator(each_protocol)
    wire = Line8N1(device, baud, garble)
    rates = rates_of("/dev/ttyUSB0", 115200)
    found = asked(each_protocol, wire, wire.tune, rates)
    assert (found[-1].baud, found[-1].reply) == (baud, Reply.ANSWERS)
    assert wire.tuned == baud
    assert set(wire.said[-1][1]) == {each_protocol.pad_byte}
    assert not device.state.moving
    first, *more = told(each_protocol, "/dev/ttyUSB0", rates, found)
    assert more == []
    if baud == 115200:
        assert first.grade is Grade.FINE
    else:
        assert first.grade is Grade.BLOCKS
        assert first.command == f"bilprov conform /dev/ttyUSB0 --baud {baud}"


def test_a_zero_at_an_unlikely_rate_is_no_answer(protocol: Protocol) -> None:
    def garble(data: bytes) -> bytes:  # a break reads as 0, which is a code too
        return b"" if wire.tuned == 115200 or not data else b"\0"

    wire = Line8N1(Simulator(protocol), 57600, garble)
    *others, right = asked(protocol, wire, wire.tune, rates_of("/dev/ttyUSB0", 115200))
    assert {one.reply for one in others} == {Reply.GARBAGE}
    assert (right.baud, right.reply) == (57600, Reply.ANSWERS)


def test_where_nobody_answers_every_rate_is_tried_and_stops_are_sent_last(
    protocol: Protocol,
) -> None:
    wire = Line8N1(Simulator(protocol), 1, lambda data: b"")
    rates = rates_of("/dev/ttyUSB0", 115200)
    assert asked(protocol, wire, wire.tune, rates) == ()
    assert {rate for rate, _ in wire.said} == set(RATES) - {250000}
    assert {byte for _, data in wire.said for byte in data} == {protocol.pad_byte}
    assert wire.said[-1][0] == 115200
    (found,) = told(protocol, "/dev/ttyUSB0", rates, ())
    assert "nobody answers at any of 11 baud rates" in found.sentence


def test_asking_that_is_given_up_still_homes_the_device(protocol: Protocol) -> None:
    wire = Line8N1(Simulator(protocol), 57600, lambda data: b"")
    assert asked(protocol, wire, wire.tune, (57600,), lambda: True) == ()
    assert [set(data) for _, data in wire.said] == [{protocol.pad_byte}]


def test_a_line_that_echoes_at_one_rate_is_asked_at_no_other(protocol: Protocol) -> None:
    class Echo(Simulator):
        def receive(self, data: bytes, now: int) -> None:
            for byte in data:
                self.answer(byte, now)

    wire = Line8N1(Echo(protocol), 9600, lambda data: b"")
    found = asked(protocol, wire, wire.tune, rates_of("/dev/ttyUSB0", 115200))
    assert [(one.baud, one.reply) for one in found] == [(9600, Reply.ECHO)]
    assert wire.tuned == 9600


@pytest.mark.parametrize("baud", [9600, 31250])
def test_each_rate_is_asked_at_once_a_round(baud: int) -> None:
    rates = rates_of(PORT, baud)
    assert sorted(rates) == sorted({*RATES, baud})
    assert rates[0] == baud
    assert rates_of("socket://127.0.0.1:5000", baud) == (baud,)


def test_a_rate_at_which_garbage_comes_is_told_once(protocol: Protocol) -> None:
    wire = Line8N1(Simulator(protocol), 1, lambda data: b"\xf8" * len(data))
    rates = (115200, 9600)
    found = asked(protocol, wire, wire.tune, rates)
    assert [one.baud for one in found] == [115200, 9600, 115200, 9600]
    assert wire.tuned == 115200
    (garbage,) = told(protocol, "/dev/ttyUSB0", rates, found)
    assert garbage.grade is Grade.BLOCKS
    assert garbage.sentence.startswith("something comes back at 115200, 9600 baud, but no answers")


def test_a_device_that_answers_otherwise_is_advised_to_be_tested(protocol: Protocol) -> None:
    class Agreeable(Simulator):
        def advance(self, now: int) -> bytes:
            return bytes(len(super().advance(now)))

    wire = Line8N1(Agreeable(protocol), 115200, lambda data: b"")
    rates = rates_of("/dev/ttyUSB0", 115200)
    found = asked(protocol, wire, wire.tune, rates)
    fine, advice = told(protocol, "/dev/ttyUSB0", rates, found)
    assert (fine.grade, advice.grade) == (Grade.FINE, Grade.ADVICE)
    assert advice.command.startswith("bilprov conform /dev/ttyUSB0")


# The command, on real lines


@pytest.mark.waits
def test_a_robot_on_a_pty_is_usable_and_hears_nothing(protocol: Protocol) -> None:
    robot = PtyRobot(protocol)
    with served(robot) as name:
        unasked = command("ports", name, "--ask", "--seconds", "0")  # without a --yes
        assert (unasked.returncode, robot.frames) == (2, [])
        result = command("ports", name, "--seconds", "0.2")
    assert (result.returncode, result.stderr) == (0, b"")
    assert robot.frames == []
    said = result.stdout.decode()
    assert "nobody else holds it" in said
    assert said.endswith(f"{name} can be used\n")


@pytest.mark.waits
def test_a_held_port_is_not_opened_and_its_holder_named() -> None:
    with open_pty() as pty:
        slave = os.open(pty.name, os.O_RDWR | os.O_NOCTTY)
        try:
            holder = subprocess.Popen(["sleep", "30"], stdin=slave)
            result = command("ports", pty.name, "--format", "json")
            holder.kill()
            holder.wait()
        finally:
            os.close(slave)
    report = json.loads(result.stdout)
    assert (result.returncode, report["exit"], report["usable"]) == (2, 2, False)
    (found,) = [one for one in report["findings"] if one["grade"] == "blocks"]
    assert (found["check"], found["command"]) == ("holder", f"kill {holder.pid}")
    assert f"sleep 30 (pid {holder.pid})" in found["sentence"]
    assert not [one for one in report["findings"] if one["check"] == "opening"]


@pytest.mark.waits
def test_an_interrupted_examination_gives_no_verdict() -> None:
    with open_pty() as pty, running("ports", pty.name, "--seconds", "600") as doctor:
        while b"opened" not in doctor.stdout.readline():
            pass
        code, out, err = doctor.end()
    assert (code, err) == (130, b"")
    assert b"not a byte was heard in " in out
    assert b"in 600 s" not in out
    assert b"can be used" not in out


@contextmanager
def robot_at(protocol: Protocol, speed: int, pty: PtyPair) -> Iterator[None]:
    """A robot at a pty's other end that is deaf unless the pty is set to its speed."""
    robot = PtyRobot(protocol)
    ended = threading.Event()

    def serve() -> None:
        now = 0
        while not ended.wait(0.005):
            now += 5_000_000
            data = pty.read()
            if data and termios.tcgetattr(pty.master)[5] == speed:
                robot.receive(data, now)
            os.write(pty.master, robot.advance(now))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.mark.waits
def test_the_baud_rate_of_a_real_line_is_found_and_advised(horn: Protocol, tmp_path: Path) -> None:
    grammar = tmp_path / "horn.py"
    grammar.write_text(horn.source, encoding="utf-8")
    with open_pty() as pty, robot_at(horn, termios.B9600, pty):
        asks = ("ports", pty.name, "--ask", "--yes", "--seconds", "0")
        result = command("--grammar", str(grammar), *asks)
        assert result.returncode == 2
        said = result.stdout.decode()
        assert b"and 10 other rates" in result.stderr
        assert "a device answers at 9600 baud, not at 115200;" in said
        assert f"bilprov conform {pty.name} --baud 9600\n" in said
        assert command("--grammar", str(grammar), *asks, "--baud", "9600").returncode == 0
