"""Reads a file of firmware for an AVR: ELF, as the linker wrote it, or Intel HEX."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

from bilprov.conformance.dut.boards import EmulatorError

_LARGEST = 1 << 24  # bytes of a file

_AVR = 83
_32_BITS_LITTLE = b"\x01\x01"
_HEADER = struct.Struct("<16sHHIIIIIHHHHHH")
_PROGRAM_HEADER = struct.Struct("<IIIIIIII")
_LOAD = 1
_ELSEWHERE = 0x800000
"""From this address on avr-gcc places RAM, EEPROM and fuses, not flash."""

_DATA, _END, _SEGMENT, _CS_IP, _LINEAR, _EIP = range(6)  # types of records of Intel HEX
_LENGTHS = {_END: 0, _SEGMENT: 2, _CS_IP: 4, _LINEAR: 2, _EIP: 4}  # data bytes of each other type

_Parts = list[tuple[int, bytes]]
"""Addresses of the flash memory, and the bytes that a file loads there."""


class Firmware(NamedTuple):
    """The bytes of a flash memory from address 0 on, and the address of the first instruction."""

    code: bytes
    start: int


def read_firmware(file: Path, size: int, start: int | None = None) -> Firmware:
    """Read the firmware in `file` for a flash memory of `size` bytes.

    It starts at the address `start`; by default where the file tells, as an ELF file does, or at
    the lowest address that a HEX file without a start record loads. What the file does not load is
    erased (FF).

    Raises EmulatorError, in one sentence, for a file that cannot be read, is of another kind or
    damaged, is not for an AVR, or does not fit.
    """
    try:
        with file.open("rb") as opened:
            data = opened.read(_LARGEST)
    except OSError as error:
        raise EmulatorError(f"{file} cannot be read ({error.strerror})") from error
    of_hex = data.lstrip().startswith(b":")
    parts, entry = _of_hex(file, data) if of_hex else _of_elf(file, data)
    end = max((address + len(part) for address, part in parts), default=0)
    if not end:
        linked = "" if of_hex else ": give the linked file"
        raise EmulatorError(f"{file} puts nothing into the flash{linked}")
    if end > size:
        raise EmulatorError(f"{file} needs {end} bytes of flash, and the board has {size}")
    image = bytearray(b"\xff" * end)
    for address, part in parts:
        image[address : address + len(part)] = part
    begin = entry if start is None else start
    if not 0 <= begin < end or begin % 2:
        raise EmulatorError(
            f"{file} has no instruction at {begin:#x}, where it is to start; it loads up to "
            f"{end - 1:#x}"
        )
    return Firmware(bytes(image), begin)


def _of_elf(file: Path, data: bytes) -> tuple[_Parts, int]:
    """What an ELF file loads, and its entry point. Raises EmulatorError."""
    if len(data) < _HEADER.size or not data.startswith(b"\x7fELF"):
        raise EmulatorError(
            f"{file} is not an ELF file: give the one that the linker wrote, or Intel HEX"
        )
    _, _, machine, _, entry, at, _, _, _, each, count, *_ = _HEADER.unpack_from(data)
    if machine != _AVR:
        raise EmulatorError(f"{file} is not for an AVR, which is all that simavr runs")
    damaged = EmulatorError(f"{file} is cut off or damaged: build it again")
    if data[4:6] != _32_BITS_LITTLE:
        raise damaged
    parts: _Parts = []
    for number in range(count):
        start = at + number * each
        if start + _PROGRAM_HEADER.size > len(data):
            raise damaged
        kind, offset, _, address, length, *_ = _PROGRAM_HEADER.unpack_from(data, start)
        if kind != _LOAD or address >= _ELSEWHERE:
            continue
        if offset + length > len(data):
            raise damaged
        parts.append((address, data[offset : offset + length]))
    return parts, entry


def _of_hex(file: Path, text: bytes) -> tuple[_Parts, int]:
    """What an Intel HEX file loads; its start record's address, or the lowest. May raise so too."""
    parts: _Parts = []
    base = 0
    start: int | None = None
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        offset, kind, data = _record(file, number, line)
        if kind == _DATA and data:
            parts.append((base + offset, data))
        elif kind in (_SEGMENT, _LINEAR):
            base = int.from_bytes(data) << (4 if kind == _SEGMENT else 16)
        elif kind == _CS_IP:
            start = (int.from_bytes(data[:2]) << 4) + int.from_bytes(data[2:])
        elif kind == _EIP:
            start = int.from_bytes(data)
        elif kind == _END:
            lowest = min((address for address, _ in parts), default=0)
            return parts, lowest if start is None else start
    raise EmulatorError(f"{file} is cut off: its last record is missing")


def _record(file: Path, number: int, line: bytes) -> tuple[int, int, bytes]:
    """The offset, the type and the data of the record in a line."""
    try:
        raw = bytes.fromhex(line.strip().removeprefix(b":").decode("ascii"))
    except ValueError:
        raw = b""
    whole = len(raw) >= 5 and len(raw) == 5 + raw[0] and sum(raw) & 0xFF == 0
    if not (line.startswith(b":") and whole and _LENGTHS.get(raw[3], raw[0]) == raw[0]):
        raise EmulatorError(
            f"{file} is not an ELF file, and as Intel HEX it is damaged in line {number}"
        )
    return int.from_bytes(raw[1:3]), raw[3], raw[4:-1]
