"""Parses the target `emulator:KIND:FIRMWARE`, the name of an emulated board."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

PREFIX = "emulator:"
SIMAVR, QEMU = "simavr", "qemu"


@dataclass(frozen=True, slots=True)
class BoardName:
    """The emulator's kind, and the firmware's ELF file."""

    kind: str
    firmware: Path

    @property
    def virtual(self) -> bool:
        """Whether the board runs in virtual time, in process."""
        return self.kind == SIMAVR


def board_named(target: str) -> BoardName | None:
    """The board that the target names, None for a target that is no emulator.

    Raises ValueError, in one sentence, for an unknown emulator or a missing firmware file.
    """
    if not target.startswith(PREFIX):
        return None
    kind, _, file = target.removeprefix(PREFIX).partition(":")
    if kind not in (SIMAVR, QEMU) or not file:
        raise ValueError(
            f"{target!r} names no board: write {PREFIX}{SIMAVR}:FIRMWARE.elf or "
            f"{PREFIX}{QEMU}:FIRMWARE.elf"
        )
    if not Path(file).is_file():
        raise ValueError(f"there is no firmware {file}; build it with: make -C firmware")
    return BoardName(kind, Path(file))
