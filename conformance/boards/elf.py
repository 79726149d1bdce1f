"""What an ELF file is for: the number of its architecture."""

from __future__ import annotations

from pathlib import Path

from conformance.boards.emulator import EmulatorError

AVR, ARM = 83, 40


def architecture(firmware: Path) -> int:
    """The file's e_machine. Raises EmulatorError, in one sentence, for a file that is no ELF."""
    try:
        with firmware.open("rb") as file:
            head = file.read(20)
    except OSError as error:
        raise EmulatorError(f"{firmware} cannot be read ({error.strerror})") from error
    if not head.startswith(b"\x7fELF") or len(head) < 20:
        raise EmulatorError(f"{firmware} is no ELF file: give the one that the compiler linked")
    return int.from_bytes(head[18:20], "little")
