"""Reads an Intel HEX file: the bytes it loads into flash memory, and where it starts."""

from __future__ import annotations

from pathlib import Path

from bilprov.conformance.dut.boards import EmulatorError

_DATA, _END, _SEGMENT, _CS_IP, _LINEAR, _EIP = range(6)  # types of records
_LENGTHS = {_END: 0, _SEGMENT: 2, _CS_IP: 4, _LINEAR: 2, _EIP: 4}  # data bytes of each other type


def flash(firmware: Path, text: bytes, size: int) -> tuple[bytes, int]:
    """The bytes that a file's text loads into a flash memory of `size` bytes, and its start.

    The bytes are those from address 0 on, and erased (FF) where the file has none. The start is the
    address of its start record, or the lowest one that it loads.

    Raises EmulatorError, in one sentence, for a text that is cut off or damaged, or that has
    nothing or too much for the flash.
    """
    image = bytearray(b"\xff" * size)
    begin, end, base = size, 0, 0
    start: int | None = None
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        offset, kind, data = _record(firmware, number, line)
        if kind == _DATA and data:
            address = base + offset
            begin, end = min(begin, address), max(end, address + len(data))
            if end > size:
                raise EmulatorError(
                    f"{firmware} needs {end} bytes of flash, and the board has {size}"
                )
            image[address : address + len(data)] = data
        elif kind in (_SEGMENT, _LINEAR):
            base = int.from_bytes(data) << (4 if kind == _SEGMENT else 16)
        elif kind == _CS_IP:
            start = (int.from_bytes(data[:2]) << 4) + int.from_bytes(data[2:])
        elif kind == _EIP:
            start = int.from_bytes(data)
        elif kind == _END:
            break
    else:
        raise EmulatorError(f"{firmware} is cut off: its last record is missing")
    if not end:
        raise EmulatorError(f"{firmware} puts nothing into the flash")
    return bytes(image[:end]), begin if start is None else start


def _record(firmware: Path, number: int, line: bytes) -> tuple[int, int, bytes]:
    """The offset, the type and the data of the record in a line."""
    try:
        raw = bytes.fromhex(line.strip().removeprefix(b":").decode("ascii"))
    except ValueError:
        raw = b""
    whole = len(raw) >= 5 and len(raw) == 5 + raw[0] and sum(raw) & 0xFF == 0
    if not (line.startswith(b":") and whole and _LENGTHS.get(raw[3], raw[0]) == raw[0]):
        raise EmulatorError(
            f"{firmware} is not an ELF file, and as Intel HEX it is damaged in line {number}"
        )
    return int.from_bytes(raw[1:3]), raw[3], raw[4:-1]
