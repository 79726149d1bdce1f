"""The doctor: what it finds on made-up machines, in traffic, and on real lines."""

from __future__ import annotations

import grp
import json
import os
import pwd
import random
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from bilprov.analyzer.doctor.examination import examined, heard, notes
from bilprov.analyzer.doctor.finding import Finding, Grade, usable
from bilprov.analyzer.transport.errors import denied
from bilprov.analyzer.transport.machine import Held, Machine
from bilprov.analyzer.transport.port import open_pty
from bilprov.captures.schemas import Chunk, Direction, Line
from bilprov.spec.protocol import Protocol
from tests.support.attaching import Talk, attached
from tests.support.commands import command, running
from tests.support.machines import FakeMachine
from tests.support.robots import RecordingRobot, served_here

PORT = "/dev/ttyUSB0"
MM_IGNORED = "E:ID_MM_DEVICE_IGNORE=1\n"
BRAILLE = "E:BRLTTY_BRAILLE_DRIVER=bm\n"


@pytest.fixture
def machine(tmp_path: Path) -> FakeMachine:
    return FakeMachine(tmp_path)


def findings(machine: Machine, name: str) -> dict[str, Finding]:
    return {one.check: one for one in examined(name, machine, ["/dev/ttyUSB0"])}


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


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to another group")
def test_who_has_joined_the_group_has_to_log_in_again(
    machine: FakeMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = machine.adapter()
    shutil.chown(machine.file(port), group="dialout")
    assert denied(port, machine).command == "sudo usermod -aG dialout $USER"
    user = pwd.getpwuid(os.geteuid()).pw_name
    joined = grp.struct_group(("dialout", "x", 20, ["other", user]))
    monkeypatch.setattr(grp, "getgrnam", lambda name: joined)
    assert denied(port, machine).command == "newgrp dialout"


@pytest.mark.parametrize(("count", "words"), [(1, "1 process is"), (2, "2 processes are")])
def test_processes_that_cannot_be_looked_into_are_no_verdict(
    machine: FakeMachine, monkeypatch: pytest.MonkeyPatch, count: int, words: str
) -> None:
    monkeypatch.setattr(machine, "held", lambda name: {name: Held(unseen=count)})
    found = findings(machine, machine.adapter())["holder"]
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
        ([(0, "host", b"\x20\x00")], Grade.FINE, "2 bytes came in 2 s"),
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


# The command, on real lines


@pytest.mark.waits
def test_a_robot_on_a_pty_is_usable_and_hears_nothing(protocol: Protocol) -> None:
    robot = RecordingRobot(protocol)
    with served_here(robot, pty=True) as (name, _):
        result = command("ports", name, "--seconds", "0.2")
    assert (result.returncode, result.stderr) == (0, b"")
    assert robot.heard == []
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
