"""Emulated boards as devices of the command line."""

from __future__ import annotations

import ctypes
from pathlib import Path

import msgspec
import pytest

from bilprov.conformance.dut.boards import EmulatorError, libsimavr
from bilprov.conformance.dut.boards.simavr import SimavrBoard
from tests.support.commands import command
from tests.support.firmware import AVR, built
from tests.support.robots import sentence

pytestmark = pytest.mark.waits


@AVR
def test_a_board_under_simavr_conforms_asks_nobody_and_brings_its_probe(tmp_path: Path) -> None:
    target = f"emulator:simavr:{built()}"
    record = tmp_path / "run.mcap"
    result = command(
        *("conform", target, "--level", "smoke", "--json", "-", "--record", str(record))
    )

    report = msgspec.json.decode(result.stdout)
    assert result.returncode == report["exit"] == 0, result.stderr
    assert report["device"] == target
    assert report["counts"]["pass"] == len(report["cases"])  # the power switch is there too
    assert command("recheck", str(record)).returncode == 0


@AVR
def test_firmware_that_crashes_is_a_silent_board_and_told(tmp_path: Path) -> None:
    file = tmp_path / "empty.elf"  # its headers, and no instruction but "do nothing"
    file.write_bytes(built().read_bytes()[:148].ljust(1 << 16, b"\0"))

    result = command("conform", f"emulator:simavr:{file}", "--level", "smoke")

    assert result.returncode == 2
    assert f"{file} crashed" in sentence(result)
    assert b"nobody answered" in result.stdout


@AVR
def test_another_version_of_the_emulator_is_told_and_not_guessed_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Other(ctypes.Structure):
        _fields_ = (("new", ctypes.c_uint64), *libsimavr._Avr._fields_)

    monkeypatch.setattr(libsimavr, "_Avr", Other)
    with pytest.raises(EmulatorError, match="is not laid out as version"):
        SimavrBoard(built())
