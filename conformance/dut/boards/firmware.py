"""Reads a file of firmware for an AVR: ELF, as the linker wrote it, or Intel HEX."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from bilprov.conformance.dut.boards import EmulatorError, elf, intel_hex

_LARGEST = 1 << 24  # bytes of a file


class Firmware(NamedTuple):
    """The bytes of a flash memory from address 0 on, and the address of the first instruction."""

    code: bytes
    start: int


def read_firmware(file: Path, size: int, start: int | None = None) -> Firmware:
    """Read the firmware in `file` for a flash memory of `size` bytes.

    It starts at the address `start`; by default where the file tells, as an ELF file does, or at
    the lowest address that a HEX file without a start record loads.

    Raises EmulatorError, in one sentence, for a file that cannot be read, is of another kind or
    damaged, is not for an AVR, or does not fit.
    """
    try:
        with file.open("rb") as opened:
            data = opened.read(_LARGEST)
    except OSError as error:
        raise EmulatorError(f"{file} cannot be read ({error.strerror})") from error
    if data.lstrip().startswith(b":"):
        code, entry = intel_hex.flash(file, data, size)
    else:
        code, entry = elf.flash(file, data, size)
    begin = entry if start is None else start
    if not 0 <= begin < len(code) or begin % 2:
        raise EmulatorError(
            f"{file} has no instruction at {begin:#x}, where it is to start; it loads up to "
            f"{len(code) - 1:#x}"
        )
    return Firmware(code, begin)
