"""Firmware in Intel HEX, boot sections, and what a reset of an emulated board leaves as it is."""

from __future__ import annotations

import select
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bilprov.analyzer.transport.port import Port, open_port
from bilprov.conformance.dut.boards import EmulatorError
from bilprov.conformance.dut.boards.firmware import read_firmware
from bilprov.conformance.dut.boards.simavr import SimavrBoard
from tests.support.firmware import AVR, END, compiled, record
from tests.support.robots import MS, PATIENCE, Served, emulate
from tests.support.wires import running

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


class Bench:
    """A board on a clock that the test moves."""

    def __init__(self, firmware: Path) -> None:
        self.board = SimavrBoard(firmware)
        self.now = 0
        self.wait(MS)

    def answer(self, data: bytes) -> bytes:
        """Send bytes one by one, each with time to be answered; gives the answers."""
        heard = b""
        for byte in data:
            self.board.receive(bytes([byte]), self.now)
            heard += self.wait(MS)
        return heard

    def wait(self, duration: int) -> bytes:
        self.now += duration
        return self.board.advance(self.now)


@pytest.fixture
def bench() -> Iterator[Callable[[Path], Bench]]:
    made: list[Bench] = []

    def make(firmware: Path) -> Bench:
        made.append(Bench(firmware))
        return made[-1]

    yield make
    for one in made:
        one.board.close()


Make = Callable[[Path], Bench]


@AVR
@pytest.mark.parametrize("at", [0, 0x7000])
def test_a_reset_starts_it_again_and_tells_it_why(bench: Make, at: int) -> None:
    line = bench(counting(at))
    assert line.answer(b"aaa") == b"\x11\x12\x13"

    line.board.reset(line.now)

    assert line.answer(b"aa") == b"\x21\x22"


@AVR
def test_the_watchdog_resets_it_after_its_new_period_and_the_chip_keeps_the_flags(
    bench: Make,
) -> None:
    line = bench(counting(0x7000))
    line.board.reset(line.now)
    assert line.answer(b"aW") == b"\x21\x22"

    line.wait(13 * MS)
    assert line.answer(b"a") == b""  # it waits for the watchdog
    line.wait(5 * MS)

    assert line.answer(b"aa") == b"\xa1\xa2"
    line.wait(2500 * MS)
    assert line.answer(b"a") == b"\xa1"


@AVR
def test_a_reset_ends_a_crash_and_leaves_out_the_time_of_it(bench: Make, tmp_path: Path) -> None:
    file = tmp_path / "a.hex"
    file.write_text(record(0, 0, b"\x00\x00" * 20) + END)  # runs into erased flash
    line = bench(file)
    line.wait(50 * MS)
    assert line.board.crashed
    line.now += 3_600_000 * MS

    line.board.reset(line.now)

    assert not line.board.crashed
    line.wait(MS)
    assert line.board.crashed


# -- on a pty -------------------------------------------------------------------------------------


def asked(port: Port, data: bytes) -> bytes:
    """The answers to bytes that are sent one by one."""
    heard = b""
    for count, byte in enumerate(data, 1):
        port.write(bytes([byte]))
        while len(heard) < count:
            assert select.select([port], [], [], PATIENCE)[0], "no answer"
            heard += port.read()
    return heard


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with emulate(counting(0x7000)) as board:
        yield board


@AVR
def test_each_opening_of_the_pty_resets_it(served: Served) -> None:
    for _ in range(3):
        with open_port(served.port) as port:
            assert asked(port, b"aa") == b"\x21\x22"


@AVR
def test_a_bridge_passes_each_opening_on(served: Served) -> None:
    with running("sniff", "--bridge", served.port, "--quiet") as sniffing:
        bridge = sniffing.stderr.readline().decode().strip().removeprefix("bilprov: ")
        for _ in range(3):
            with open_port(bridge) as port:
                assert asked(port, b"aa") == b"\x21\x22"
        assert sniffing.end()[0] == 0


@AVR
def test_each_connection_resets_it() -> None:
    with emulate(counting(), "--listen", "127.0.0.1:0") as board:
        for _ in range(2):
            with open_port(board.port) as port:
                assert asked(port, b"aa") == b"\x21\x22"
