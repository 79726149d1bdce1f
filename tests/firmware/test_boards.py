"""Emulated boards as devices of the command line."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from bilprov.conformance.dut.boards import EmulatorError, libsimavr
from bilprov.conformance.dut.boards.simavr import SimavrBoard
from tests.support.commands import command, process
from tests.support.firmware import AVR, built
from tests.support.robots import sentence

pytestmark = pytest.mark.waits


@AVR
def test_a_board_under_simavr_conforms_asks_nobody_and_brings_its_probe(tmp_path: Path) -> None:
    target = f"emulator:simavr:{built()}"
    record = tmp_path / "run.mcap"
    result = process(
        *("conform", target, "--level", "smoke", "--json", "-", "--record", str(record))
    )

    report = msgspec.json.decode(result.stdout)
    assert result.returncode == report["exit"] == 0, result.stderr
    assert report["device"] == target
    assert report["counts"]["pass"] == len(report["cases"])  # the power switch is there too
    assert command("recheck", str(record)).returncode == 0


@AVR
def test_a_board_with_a_bug_does_not_conform() -> None:
    target = f"emulator:simavr:{built('-DBUG_STOP_KEEPS_PWM')}"

    assert process("conform", target, "--level", "smoke", "--fail-fast").returncode == 1


@AVR
@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda elf: elf[:200], "is cut off or damaged"),
        (lambda elf: elf[:60], "is cut off or damaged"),
        (lambda elf: b"", "is not an ELF file: give the one that the linker wrote"),
        (lambda elf: b":100000000C9434000C943E00\n", "is not an ELF file"),
        (lambda elf: elf[:18] + b"\x28" + elf[19:], "is not for an AVR, which is all that simavr"),
        (lambda elf: elf[:44] + bytes(2) + elf[46:], "puts nothing into the flash"),
        (lambda elf: elf[:64] + b"\x00\x7f\0\0" + elf[68:], "bytes of flash"),
    ],
)
def test_a_damaged_file_is_one_sentence_and_no_crash(
    tmp_path: Path, damage: Callable[[bytes], bytes], words: str
) -> None:
    file = tmp_path / "damaged.elf"
    file.write_bytes(damage(built().read_bytes()))

    result = command("conform", f"emulator:simavr:{file}")

    assert result.returncode == 2
    assert words in sentence(result)


@AVR
def test_firmware_that_crashes_is_a_silent_board_and_told(tmp_path: Path) -> None:
    file = tmp_path / "empty.elf"  # its headers, and no instruction but "do nothing"
    file.write_bytes(built().read_bytes()[:148].ljust(1 << 16, b"\0"))

    result = command("conform", f"emulator:simavr:{file}")

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


@pytest.mark.parametrize(
    ("target", "more", "words"),
    [
        ("emulator:foo:x.elf", (), "names no board"),
        ("emulator:simavr", (), "names no board"),
        ("emulator:simavr:none.elf", (), "there is no firmware none.elf"),
        ("emulator:simavr:{text}", (), "is not an ELF file"),
        ("emulator:qemu:{text}", (), "names no board: write emulator:simavr:FIRMWARE.elf"),
        ("emulator:simavr:{intel}", (), "not for an AVR"),
        ("emulator:simavr:{text}", ("--probe", "none"), "brings its own probe"),
        ("emulator:simavr:{text}", ("--fault", "dead"), "--fault is for the target sim"),
        ("emulator:simavr:{text}", ("--power", "exec:true"), "is for ports"),
    ],
)
def test_wrong_use_is_one_sentence(
    tmp_path: Path, target: str, more: tuple[str, ...], words: str
) -> None:
    text, intel = tmp_path / "a.txt", tmp_path / "b.elf"
    text.write_text("no firmware")
    intel.write_bytes(b"\x7fELF\x01\x01" + bytes(12) + b"\x3e\x00" + bytes(40))

    result = command("conform", target.format(text=text, intel=intel), *more)

    assert (result.returncode, result.stdout) == (2, b"")
    assert words in sentence(result)
