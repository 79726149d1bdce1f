"""Reads an ELF file for an AVR: the bytes it loads into flash memory, and where it starts."""

from __future__ import annotations

import struct
from pathlib import Path

from bilprov.conformance.dut.boards import EmulatorError

_AVR = 83
_32_BITS_LITTLE = b"\x01\x01"
_HEADER = struct.Struct("<16sHHIIIIIHHHHHH")
_SEGMENT = struct.Struct("<IIIIIIII")
_LOAD = 1
_ELSEWHERE = 0x800000
"""From this address on avr-gcc places RAM, EEPROM and fuses, not flash."""


def flash(firmware: Path, data: bytes, size: int) -> tuple[bytes, int]:
    """The bytes that a file's `data` load into a flash memory of `size` bytes, and its entry point.

    The bytes are those from address 0 on, and erased (FF) where the file has none.

    Raises EmulatorError, in one sentence, for data that are no ELF file, not for an AVR, cut off or
    damaged, or that have nothing or too much for the flash.
    """
    if len(data) < _HEADER.size or not data.startswith(b"\x7fELF"):
        raise EmulatorError(
            f"{firmware} is not an ELF file: give the one that the linker wrote, or Intel HEX"
        )
    _, _, machine, _, entry, at, _, _, _, each, count, *_ = _HEADER.unpack_from(data)
    if machine != _AVR:
        raise EmulatorError(f"{firmware} is not for an AVR, which is all that simavr runs")
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
    return bytes(image[:end]), entry


def _damaged(firmware: Path) -> EmulatorError:
    return EmulatorError(f"{firmware} is cut off or damaged: build it again")
