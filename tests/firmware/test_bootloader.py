"""The real avrdude with the simulated bootloader, and with emulated real ones over a bridge."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from random import Random

import pytest

from tests.support.bridges import Traffic, bridged
from tests.support.firmware import needs
from tests.support.robots import PATIENCE, emulate, simulate

OPTIBOOT = Path("/usr/share/arduino/hardware/arduino/avr/bootloaders/optiboot")
ATMEGABOOT = OPTIBOOT.parent / "atmega" / "ATmegaBOOT_168_atmega328.hex"  # as Debian builds it
PROGRAMS = needs(
    "avr-gcc",
    "avrdude",
    files=[OPTIBOOT / "optiboot.c", ATMEGABOOT],
    simavr=True,
    package="gcc-avr avr-libc simavr avrdude arduino-core-avr",
)

pytestmark = pytest.mark.waits

SIGNATURE = "1e950f"  # of an ATmega328P
LATE = ("protocol expects", "programmer is not responding")
TRIES = 3
WAITS = b"\xff\xcf"  # a program that jumps to itself; what follows is never run


@pytest.fixture
def optiboot(tmp_path: Path) -> Path:
    """Optiboot 4.4 as Intel HEX, linked for a boot section of 1 KiB.

    Debian builds it larger than the 512 bytes for which Arduino's own file is linked, and its end
    would not fit into the flash.
    """
    elf, file = tmp_path / "optiboot.elf", tmp_path / "optiboot.hex"
    compiling = ["avr-gcc", "-Os", "-fno-split-wide-types", "-mmcu=atmega328p", f"-I{OPTIBOOT}"]
    compiling += ["-DF_CPU=16000000L", "-DLED_START_FLASHES=3", "-DBAUD_RATE=115200"]
    linking = ["-Wl,--section-start=.text=0x7c00", "-Wl,--section-start=.version=0x7ffe"]
    linking += ["-Wl,--relax", "-nostartfiles", "-o", str(elf), str(OPTIBOOT / "optiboot.c")]
    subprocess.run([*compiling, *linking], check=True, capture_output=True)
    subprocess.run(["avr-objcopy", "-O", "ihex", elf, file], check=True)
    return file


def avrdude(
    serve: Callable[[], AbstractContextManager[str]], *words: str, programmer: str = "arduino"
) -> str:
    """What avrdude prints while it programs an ATmega328P behind a port.

    It takes an answer that comes a quarter of a second late, as on a busy machine, for that to its
    next question, and gives up, as it does after 5 s: then it is begun anew, with what is served.
    """
    for _ in range(TRIES):
        with serve() as port:
            whole = ["avrdude", "-c", programmer, "-p", "m328p", "-P", port, "-b", "115200", *words]
            done = subprocess.run(
                whole, capture_output=True, text=True, timeout=PATIENCE, check=False
            )
        if not any(reason in done.stderr for reason in LATE):
            break
    assert done.returncode == 0, done.stderr
    return done.stderr


@needs("avrdude", package="avrdude")
@pytest.mark.parametrize("programmer", ["arduino", "stk500v1"])  # which asks by serial programming
def test_avrdude_writes_a_program_to_the_simulated_bootloader(
    programmer: str, tmp_path: Path
) -> None:
    program = tmp_path / "program.bin"
    program.write_bytes(Random(2).randbytes(300))

    @contextmanager
    def simulated() -> Iterator[str]:
        with simulate(pty=True, grammar="stk500v1") as served:
            yield served.port

    told = avrdude(simulated, "-U", f"flash:w:{program}:r", programmer=programmer)

    assert f"device signature = 0x{SIGNATURE}" in told
    assert "300 bytes of flash verified" in told


@pytest.mark.sample(1)
@PROGRAMS
@pytest.mark.timeout(300)
@pytest.mark.parametrize("start", [["--start", "0x7c00"], []], ids=["Optiboot", "ATmegaBOOT"])
def test_avrdude_writes_a_program_and_every_byte_of_it_is_decoded(
    optiboot: Path, tmp_path: Path, start: list[str]
) -> None:
    program, capture = tmp_path / "program.bin", tmp_path / "flashing.mcap"
    firmware = optiboot if start else ATMEGABOOT
    written = WAITS + Random(1).randbytes(398)
    program.write_bytes(written)

    @contextmanager
    def behind_a_bridge() -> Iterator[str]:
        capture.unlink(missing_ok=True)
        with emulate(firmware, *start, grammar="stk500v1") as board:
            with suppress(PermissionError):  # it has to keep up with avrdude, which is no emulation
                os.setpriority(os.PRIO_PROCESS, board.process.pid, -10)
            with bridged("stk500v1", board.port, capture) as port:
                yield port

    # -D: it is told to erase nothing
    told = avrdude(behind_a_bridge, "-D", "-U", f"flash:w:{program}:r")
    assert "400 bytes of flash verified" in told

    traffic = Traffic(capture)
    traffic.require_nothing_odd()
    names = [one["name"] for one in traffic.requests]
    assert names.count("ProgPage") == 4  # of 128 bytes
    assert names[-1] == "LeaveProgmode"
    read = {"ReadSign": "", "ReadPage": ""}
    for request in traffic.requests:
        answer = traffic.answers[request["sequence"]]
        assert answer["name"] == "OK"
        if request["name"] in read:
            (value,) = answer["fields"].values()
            read[request["name"]] += value
    assert read["ReadSign"] == SIGNATURE
    assert written.hex() in read["ReadPage"]
