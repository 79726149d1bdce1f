"""Reads an ELF file: its processor architecture, and the bytes it loads into flash memory."""

from __future__ import annotations

import struct
from pathlib import Path

from bilprov.conformance.dut.boards import EmulatorError

AVR = 83

_32_BITS_LITTLE = b"\x01\x01"
_HEADER = struct.Struct("<16sHHIIIIIHHHHHH")
_SEGMENT = struct.Struct("<IIIIIIII")
_LOAD = 1
_ELSEWHERE = 0x800000
"""From this address on avr-gcc places RAM, EEPROM and fuses, not flash."""
_LARGEST = 1 << 24  # bytes of a file


def architecture(firmware: Path) -> int:
    """The file's e_machine, such as AVR. Raises EmulatorError for a file that is no ELF."""
    return int(_header(firmware, _read(firmware))[2])


def flash(firmware: Path, size: int) -> bytes:
    """The bytes that the file loads into a flash memory of `size` bytes, from address 0 on.

    Raises EmulatorError, in one sentence, for a file that is cut off or damaged, or that has
    nothing or too much for the flash.
    """
    data = _read(firmware)
    _, _, _, _, _, at, _, _, _, each, count, *_ = _header(firmware, data)
    if data[4:6] != _32_BITS_LITTLE:
        raise _damaged(firmware)
    image = bytearray(b"\xff" * size)
    end = 0
    for number in range(count):
        start = at + number * each
        if start + _SEGMENT.size > len(data):
            raise _damaged(firmware)
        kind, offset, _, address, length, *_ = _SEGMENT.unpack_from(data, start)
        if kind != _LOAD or address >= _ELSEWHERE:
            continue
        if offset + length > len(data):
            raise _damaged(firmware)
        if address + length > size:
            raise EmulatorError(
                f"{firmware} needs {address + length} bytes of flash, and the board has {size}"
            )
        image[address : address + length] = data[offset : offset + length]
        end = max(end, address + length)
    if not end:
        raise EmulatorError(f"{firmware} puts nothing into the flash: give the linked file")
    return bytes(image[:end])


def _damaged(firmware: Path) -> EmulatorError:
    return EmulatorError(f"{firmware} is cut off or damaged: build it again")


def _read(firmware: Path) -> bytes:
    try:
        with firmware.open("rb") as file:
            return file.read(_LARGEST)
    except OSError as error:
        raise EmulatorError(f"{firmware} cannot be read ({error.strerror})") from error


def _header(firmware: Path, data: bytes) -> tuple[int, ...]:
    if len(data) < _HEADER.size or not data.startswith(b"\x7fELF"):
        raise EmulatorError(f"{firmware} is not an ELF file: give the one that the linker wrote")
    return _HEADER.unpack_from(data)
