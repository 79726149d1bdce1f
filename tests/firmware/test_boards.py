"""Emulated boards as devices of the command line."""

from __future__ import annotations

import ctypes
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from bilprov.conformance.dut.boards import EmulatorError, libsimavr
from bilprov.conformance.dut.boards.simavr import SimavrBoard
from tests.support import ROOT
from tests.support.commands import command, process
from tests.support.firmware import AVR, QEMU, built, emulator_of
from tests.support.robots import PATIENCE, sentence, unwell

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


@QEMU
def test_a_board_under_qemu_conforms() -> None:
    target = f"emulator:qemu:{built('-DAWAKE')}"
    result = process("conform", target, "--level", "smoke", "--json", "-", timeout=110)

    assert unwell(result) == {}  # nothing is skipped: its power is switched too
    report = msgspec.json.decode(result.stdout)
    assert (report["device"], report["link"]["probe"]) == (target, "qemu")


def judging_under_qemu() -> subprocess.Popen[bytes]:
    """The command at work on a board under QEMU."""
    words = ("conform", f"emulator:qemu:{built('-DAWAKE')}", "--level", "smoke", "--json", "-")
    return subprocess.Popen(
        [sys.executable, "-m", "bilprov", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
    )


def somewhere_in(run: subprocess.Popen[bytes]) -> int:
    """Wait until a run is past its power cycles, each of which is another process of QEMU."""
    before = None
    while (emulator := emulator_of(run.pid)) is None or emulator != before:
        assert run.poll() is None
        before = emulator
        time.sleep(1.5)
    return emulator


@QEMU
def test_an_emulator_that_ends_in_the_middle_is_told_in_one_sentence() -> None:
    with judging_under_qemu() as run:
        emulator = somewhere_in(run)
        os.kill(emulator, signal.SIGKILL)
        out, err = run.communicate(timeout=PATIENCE)

    assert run.returncode == 2
    assert b"emulator has ended" in err or b"was closed by the other side" in err, err
    assert b"Traceback" not in err
    assert msgspec.json.decode(out)["exit"] == 2


@QEMU
def test_an_emulator_ends_with_the_kit_even_where_that_is_killed() -> None:
    with judging_under_qemu() as run:
        emulator = somewhere_in(run)
        ends = os.pidfd_open(emulator)
        run.kill()

    ready, _, _ = select.select([ends], [], [], PATIENCE)
    os.close(ends)
    if not ready:
        os.kill(emulator, signal.SIGKILL)
    assert ready


@QEMU
def test_firmware_that_is_no_robot_is_told_in_one_sentence(tmp_path: Path) -> None:
    file = tmp_path / "zeros.elf"
    file.write_bytes(built("-DAWAKE").read_bytes()[:20] + bytes(100))

    result = command("conform", f"emulator:qemu:{file}", "--level", "smoke")

    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    assert b"Traceback" not in result.stderr


@AVR
@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda elf: elf[:200], "is cut off or damaged"),
        (lambda elf: elf[:60], "is cut off or damaged"),
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
        ("emulator:qemu:{text}", (), "is not an ELF file"),
        ("emulator:simavr:{intel}", (), "not for an AVR"),
        ("emulator:qemu:{intel}", (), "neither for an AVR nor for an ARM"),
        ("emulator:simavr:{text}", ("--probe", "none"), "brings its own probe"),
        ("emulator:simavr:{text}", ("--fault", "dead"), "--fault is for the target sim"),
        ("emulator:qemu:{text}", ("--power", "exec:true"), "is for ports"),
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
