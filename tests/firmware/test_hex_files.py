"""Firmware in Intel HEX, boot sections, and what a reset of an emulated board leaves as it is."""

from __future__ import annotations

import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest

from bilprov.analyzer.transport.port import open_port
from bilprov.conformance.dut.boards import EmulatorError
from bilprov.conformance.dut.boards.firmware import read_firmware
from tests.support.commands import running
from tests.support.firmware import AVR, END, Bench, compiled, record
from tests.support.robots import MS, emulate
from tests.support.wires import read_from

pytestmark = pytest.mark.waits

SIZE = 1 << 15  # bytes of flash

# Each answer is the number of bytes since the reset, and in the upper half why it was reset: 1 by
# its power, 2 by the reset pin, 8 by the watchdog, which has 2 s at first and 16 ms after a W.
COUNTS = Path(__file__).with_name("counts.c").read_text(encoding="utf-8")


def counting(at: int = 0) -> Path:
    """A HEX file of that firmware, linked for a section that begins at an address."""
    elf = compiled(COUNTS, f"-Wl,--section-start=.text={at:#x}")
    file = elf.with_suffix(".hex")
    subprocess.run(["avr-objcopy", "-O", "ihex", elf, file], check=True)
    return file


@pytest.mark.parametrize(
    ("records", "code", "start"),
    [
        # Typed from the description of the format, with its own check sums.
        (":0300300002337A1E\n:00000001FF\n", b"\xff" * 48 + b"\x02\x33\x7a", 0x30),
        (":02000002100EDE\n:0100000041BE\n:00000001FF\n", b"\xff" * 0x100E0 + b"A", 0x100E0),
        (":020000040001F9\n:0100020042BB\n:00000001FF\n", b"\xff" * 0x10002 + b"B", 0x10002),
        (":0400000300000002F7\n:040000000102030\n", None, 0),
        (":0400000300000002F7\n:0400000001020304F2\n:00000001FF\n", b"\1\2\3\4", 2),
        (":0400000500000000F7\n:0400000001020304F2\n:00000001FF\n", b"\1\2\3\4", 0),
    ],
)
def test_records_are_read(tmp_path: Path, records: str, code: bytes | None, start: int) -> None:
    file = tmp_path / "a.hex"
    file.write_text(records)

    if code is None:
        with pytest.raises(EmulatorError, match="damaged in line 2"):
            read_firmware(file, 1 << 17)
    else:
        assert read_firmware(file, 1 << 17) == (code, start)


def test_lines_may_end_as_on_windows_and_the_start_may_be_given(tmp_path: Path) -> None:
    file = tmp_path / "a.hex"
    file.write_bytes((record(0x7C00, 0, bytes(8)) + END).replace("\n", "\r\n").encode())

    assert read_firmware(file, SIZE).start == 0x7C00
    assert read_firmware(file, SIZE, start=0x7C02).start == 0x7C02


# -- in virtual time ------------------------------------------------------------------------------


def answered(line: Bench, data: bytes) -> bytes:
    """The answers to bytes that are sent one by one, each with time to be answered."""
    return b"".join(line.send(bytes([byte]), wait=MS, answers=None) for byte in data)


def passed(line: Bench, duration: int) -> None:
    """Let time (ns) pass."""
    line.send(b"", wait=duration, answers=None)


@AVR
@pytest.mark.parametrize("at", [0, 0x7000])
def test_a_reset_starts_it_again_and_tells_it_why(at: int) -> None:
    line = Bench(counting(at))
    assert answered(line, b"aaa") == b"\x11\x12\x13"

    line.board.reset(line.now)

    assert answered(line, b"aa") == b"\x21\x22"


@AVR
def test_the_watchdog_resets_it_after_its_new_period_and_the_chip_keeps_the_flags() -> None:
    line = Bench(counting(0x7000))
    passed(line, MS)  # and the flags of its power-on are read
    line.board.reset(line.now)
    assert answered(line, b"aW") == b"\x21\x22"

    passed(line, 13 * MS)
    assert answered(line, b"a") == b""  # it waits for the watchdog
    passed(line, 5 * MS)

    assert answered(line, b"aa") == b"\xa1\xa2"
    passed(line, 2500 * MS)
    assert answered(line, b"a") == b"\xa1"


@AVR
def test_a_reset_ends_a_crash_and_leaves_out_the_time_of_it(tmp_path: Path) -> None:
    file = tmp_path / "a.hex"
    file.write_text(record(0, 0, b"\x00\x00" * 20) + END)  # runs into erased flash
    line = Bench(file)
    passed(line, 50 * MS)
    assert line.board.crashed
    late = line.now + 3_600_000 * MS

    line.board.reset(late)

    assert not line.board.crashed
    line.board.advance(late + MS)
    assert line.board.crashed


# -- on a pty -------------------------------------------------------------------------------------


@AVR
@pytest.mark.parametrize("how", ["on a pty", "behind a bridge", "on a socket"])
def test_each_opening_resets_it(how: str) -> None:
    listens = ["--listen", "127.0.0.1:0"] if how == "on a socket" else []
    with ExitStack() as stack:
        port = stack.enter_context(emulate(counting(0x7000), *listens)).port
        if how == "behind a bridge":
            sniffing = stack.enter_context(running("sniff", "--bridge", port, "--quiet"))
            port = sniffing.stderr.readline().decode().strip().removeprefix("bilprov: ")
        for _ in range(3):
            with open_port(port) as line:
                for answer in (b"\x21", b"\x22"):
                    line.write(b"a")
                    assert read_from(line, 1) == answer
