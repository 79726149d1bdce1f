"""Frames whose end only silence tells, and those before it is clear where frames begin."""

from __future__ import annotations

import os
import select
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bilprov.analyzer import api
from bilprov.analyzer.cli.options import above_latency
from bilprov.analyzer.client import port_driver as of_device
from bilprov.analyzer.decode.records import HostRecord
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.replay import target as of_target
from bilprov.analyzer.screen.details import details
from bilprov.analyzer.transport import machine as of_machine
from bilprov.analyzer.transport.port import open_pty
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk
from tests.support.captures import about, write_capture
from tests.support.commands import command
from tests.support.decoding import MS, decoded, hosts
from tests.support.machines import FakeMachine

MODBUS = load_protocol("modbus-rtu")
READ = bytes.fromhex("1103006b00037687")  # section 6.3 of the document, with its address and check
UNKNOWN = bytes.fromhex("116400010203")  # no function 100, and no check is right
SILENT_END = "its end is uncertain: only silence marks it"


def test_the_details_of_a_frame_that_only_silence_ends_have_a_line_of_it() -> None:
    events = [Chunk(MS, "host", UNKNOWN), Chunk(500 * MS, "host", READ)]
    odd, whole = hosts(decoded(Session(MODBUS, heard=frozenset({"host"})), events))
    for record, lines in ((odd, [SILENT_END]), (whole, [])):
        found = details(MODBUS, record, state=False)
        assert [one.text for one in found if one.label == "uncertain"] == lines


@pytest.fixture
def machine(tmp_path: Path) -> FakeMachine:
    return FakeMachine(tmp_path)


def test_a_frame_is_not_cut_by_a_pause_that_an_adapter_makes(
    machine: FakeMachine, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    usb = machine.adapter(latency=16)
    monkeypatch.setattr(of_machine, "Machine", lambda: machine)
    ports = (usb, "/dev/ttyS0", "socket://localhost:4000")
    assert above_latency(50 * MS, *ports) == 50 * MS
    assert above_latency(5 * MS, *ports[1:]) == 5 * MS
    assert not capsys.readouterr().err
    timeout = above_latency(5 * MS, *ports)
    said = capsys.readouterr().err
    assert "a frame is cut after 20 ms of silence instead of 5 ms" in said

    frame = UNKNOWN + bytes.fromhex("6233")
    late = [Chunk(0, "host", frame[:3]), Chunk(16 * MS, "host", frame[3:])]
    (one,) = hosts(decoded(Session(MODBUS, timeout=timeout), late))
    assert (one.data, one.uncertain) == (frame, False)
    assert len(hosts(decoded(Session(MODBUS, timeout=5 * MS), late))) == 2


def test_sniff_cuts_and_records_by_what_its_adapter_needs(
    tmp_path: Path, machine: FakeMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(of_machine, "Machine", lambda: machine)
    with open_pty() as pair:
        machine.write(f"/sys/class/tty/{Path(pair.name).name}/device/latency_timer", "16")
        path = tmp_path / "line.mcap"
        words = (pair.name, "-w", str(path), "--truncation-timeout", "5")
        done = command("sniff", *words, "--duration", "0.05", "--quiet")
    assert done.returncode == 0, done.stderr
    assert open_capture(path).metadata["truncation_timeout_ms"] == "20"


def test_listening_from_python_does_not_cut_below_the_adapters_latency(
    machine: FakeMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(api, "Machine", lambda: machine)
    frame = UNKNOWN + bytes.fromhex("6233")
    with open_pty() as pair:
        machine.write(f"/sys/class/tty/{Path(pair.name).name}/device/latency_timer", "1000")
        records = api.sniff(pair.name, protocol=MODBUS)
        for wait, part in ((0.05, frame[:3]), (0.2, frame[3:])):
            threading.Timer(wait, os.write, (pair.master, part)).start()
        found = next(one for one in records if isinstance(one, HostRecord))
        records.close()  # type: ignore[attr-defined]
    assert found.data == frame


ANSWER = bytes.fromhex("110306022B00000064C8BA")


@contextmanager
def answering_late(machine: FakeMachine, pause: float) -> Iterator[str]:
    """A port whose adapter holds back the rest of an answer for so many seconds."""
    with open_pty() as pair:
        machine.write(f"/sys/class/tty/{Path(pair.name).name}/device/latency_timer", "2000")

        def answers() -> None:
            select.select([pair.master], [], [])
            os.write(pair.master, ANSWER[:4])
            time.sleep(pause)
            os.write(pair.master, ANSWER[4:])

        thread = threading.Thread(target=answers)
        thread.start()
        yield pair.name
        thread.join()  # else it writes to whatever has the descriptor of the closed pty


def test_a_client_waits_for_the_rest_of_an_answer_that_an_adapter_holds_back(
    machine: FakeMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(of_device, "Machine", lambda: machine)
    with (
        answering_late(machine, 0.1) as port,  # twice the longest pause of the grammar
        of_device.Device(port, grammar=MODBUS, address=17) as meter,
    ):
        assert meter.read_holding_registers(0x6B, 3) == (555, 0, 100)


def test_an_answer_to_a_faster_replay_is_not_cut_by_a_pause_that_an_adapter_makes(
    tmp_path: Path, machine: FakeMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(of_target, "Machine", lambda: machine)
    asked = [Chunk(MS, "host", READ), Chunk(2 * MS, "device", ANSWER)]
    capture = write_capture(tmp_path / "line.mcap", asked, about(MODBUS))
    with answering_late(machine, 0.02) as port:
        done = command("replay", str(capture), "--to", port, "--yes", "--rate", "20")
    assert done.returncode == 0, done.stdout + done.stderr
    assert b"1 instruction sent, 0 differences" in done.stderr
