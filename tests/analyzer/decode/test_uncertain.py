"""Frames whose end only silence tells, and those before it is clear where frames begin."""

from __future__ import annotations

import csv
import io
import json
import os
import select
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from bilprov.analyzer import api
from bilprov.analyzer.cli.options import above_latency
from bilprov.analyzer.client import port_driver as of_device
from bilprov.analyzer.decode.batch import Records
from bilprov.analyzer.decode.records import HostRecord, Record
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.output.outputs import json_text
from bilprov.analyzer.output.row_columns import CsvText, Times, usual_columns
from bilprov.analyzer.output.text_lines import LineRenderer
from bilprov.analyzer.replay import target as of_target
from bilprov.analyzer.screen.details import details
from bilprov.analyzer.transport import machine as of_machine
from bilprov.analyzer.transport.port import open_pty
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk
from bilprov.spec.protocol import Protocol
from tests.support.captures import about, write_capture
from tests.support.commands import command
from tests.support.decoding import MS, decoded, devices, hosts
from tests.support.machines import FakeMachine

MODBUS, STK500 = load_protocol("modbus-rtu"), load_protocol("stk500v1")
READ = bytes.fromhex("1103006b00037687")  # section 6.3 of the document, with its address and check
UNKNOWN = bytes.fromhex("116400010203")  # no function 100, and no check is right
SILENT_END = "its end is uncertain: only silence marks it"
UNCLEAR = "came before it was clear where frames begin"


def rows(protocol: Protocol, records: Sequence[Record]) -> list[dict[str, str]]:
    """The records as CSV."""
    table = CsvText(usual_columns(protocol), Times())
    return list(csv.DictReader(io.StringIO(table.header + table.text(records))))


def test_a_frame_that_only_silence_ends_is_uncertain_wherever_it_is_shown() -> None:
    events = [Chunk(MS, "host", UNKNOWN), Chunk(500 * MS, "host", READ)]
    odd, whole = hosts(decoded(Session(MODBUS, heard=frozenset({"host"})), events))

    assert (odd.uncertain, whole.uncertain) == (True, False)
    assert (msgspec.json.decode(msgspec.json.encode(odd.value))["uncertain"]) is True
    assert msgspec.to_builtins(whole.value)["uncertain"] is False
    assert odd.value.reason == odd.reason == f"crc is 02 03, right is 85 07; {SILENT_END}"
    assert LineRenderer(colour=False).line(odd).endswith(SILENT_END)
    texts = [(one.label, one.text) for one in details(MODBUS, odd, state=False)]
    assert ("uncertain", SILENT_END) in texts
    assert "uncertain" not in [one.label for one in details(MODBUS, whole, state=False)]
    first, second = map(json.loads, json_text([odd, whole]).splitlines())
    assert (first["uncertain"], "uncertain" in second) == (True, False)
    assert [row["uncertain"] for row in rows(MODBUS, [odd, whole])] == ["true", ""]
    chosen = compile_filter("'uncertain' in reason", MODBUS).selection(Records([odd, whole]))
    assert chosen.host.tolist() == [True, False]


def test_an_end_mark_tells_the_end_and_a_frame_without_it_is_uncertain() -> None:
    for frame, certain in (("6620", True), ("660120", False), ("6601", False)):
        (one,) = hosts(decoded(Session(STK500), [Chunk(0, "host", bytes.fromhex(frame))]))
        assert one.uncertain is not certain


def test_an_answer_that_only_silence_ends_is_uncertain() -> None:
    events = [Chunk(0, "host", READ), Chunk(MS, "device", bytes.fromhex("11030602"))]
    (one,) = devices(decoded(Session(MODBUS), events))
    assert one.uncertain
    assert msgspec.to_builtins(one.value)["uncertain"] is True
    assert one.reason.endswith(SILENT_END)
    line = json.loads(json_text([one]))
    assert line["uncertain"] is True
    assert line["faults"] == ["damaged answer"]


def test_frames_are_uncertain_until_a_check_is_right() -> None:
    """Listening began in the middle of a request: what is left of it looks like a broken one."""
    rest = bytes.fromhex("05030001000212ab")
    events = [Chunk(t * MS, "host", data) for t, data in enumerate((rest, READ, rest), 1)]
    found = hosts(decoded(Session(MODBUS, attached=True), events))
    assert [one.data for one in found] == [rest, READ, rest]
    assert [one.uncertain for one in found] == [True, False, False]
    assert found[0].reason.endswith(UNCLEAR)


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
