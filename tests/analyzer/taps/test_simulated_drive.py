"""`bilprov sniff sim`: a drive to look at that no device makes."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path

import pytest

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.taps.simulated_drive import SimulatedDrive, drive
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.captures.reader import open_capture
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol
from tests.support.commands import command

BYTE_TIME = 86_805
FRAMES = 600


def test_each_frame_is_answered_as_a_conforming_device_does(
    protocol: Protocol, wide: Protocol
) -> None:
    for one in (protocol, wide):
        chunks = list(islice(drive(one, BYTE_TIME), 2 * FRAMES))
        judged = [judge(one, chunk.data) for chunk in chunks[::2]]

        assert [chunk.direction for chunk in chunks] == ["host", "device"] * FRAMES
        answers = [bytes([judgement.response.code]) for judgement in judged]
        assert [chunk.data for chunk in chunks[1::2]] == answers
        faulty = sum(not judgement.valid for judgement in judged)
        assert 0.02 < faulty / FRAMES < 0.2
        assert [c.t for c in chunks] == sorted(c.t for c in chunks)


def test_it_is_the_same_for_the_same_seed_and_another_for_another(protocol: Protocol) -> None:
    def said(seed: int) -> list[bytes]:
        return [chunk.data for chunk in islice(drive(protocol, BYTE_TIME, seed), 40)]

    assert said(1) == said(1) != said(2)


def test_the_host_stops_soon_after_it_has_set_the_robot_moving(protocol: Protocol) -> None:
    state = protocol.power_on
    moving, longest = 0, 0
    for chunk in islice(drive(protocol, BYTE_TIME), 0, 2 * FRAMES, 2):
        judged = judge(protocol, chunk.data)
        effect = judged.instruction.effect if judged.instruction else protocol.on_fault
        effect = effect if judged.valid else protocol.on_fault
        state = effect.apply(state, dict(judged.fields))
        moving = moving + 1 if protocol.directed(state) else 0
        longest = max(longest, moving)

    assert 1 < longest < 8


def test_what_does_not_drive_is_called_by_its_noun() -> None:
    modbus = load_protocol("modbus-rtu")

    assert SimulatedDrive(modbus, line_settings(modbus)).names == {"simulated": modbus.device}


@pytest.mark.waits
def test_it_is_sniffed_as_a_line_and_recorded_as_what_it_is(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    listened = ("sniff", "sim", "--format", "jsonl", "--count", "6", "-w", str(path))

    result = command(*listened, "--judge")

    rows = [json.loads(line) for line in result.stdout.splitlines()]
    assert result.returncode == 0
    # On a busy machine a row notes that the sniffer was late.
    kinds = [row["kind"] for row in rows if row["kind"] != "fault"]
    assert kinds[:4] == ["instruction", "response"] * 2
    assert rows[-1]["kind"] == "judgement"
    capture = open_capture(path)
    assert capture.metadata["port_simulated"] == "drive"
    assert not {"port_host", "port_device", "port_bridge"} & set(capture.metadata)


def test_it_has_no_other_port_beside_it_and_a_file_of_that_name_comes_first(
    tmp_path: Path,
) -> None:
    for more in (["/dev/x"], ["--bridge", "/dev/x"]):
        result = command("sniff", "sim", *more)
        assert (result.returncode, result.stdout) == (2, b"")
        assert b"name it alone" in result.stderr
    (tmp_path / "sim").touch()
    result = command("sniff", "sim", cwd=tmp_path)
    assert (result.returncode, result.stdout) == (2, b"")
    assert b"sim is not a serial port" in result.stderr
