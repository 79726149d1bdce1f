"""Firmware that cannot be run, and options that do not go with it: one sentence, and no crash."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.commands import command
from tests.support.firmware import AVR, built
from tests.support.robots import sentence

pytestmark = [pytest.mark.waits, AVR]

CONFORM, SERVE = "conform emulator:simavr:{file} --level smoke", "simulate --firmware {file}"


def empty(elf: bytes) -> bytes:
    """An ELF file with its headers, and no instruction but "do nothing"."""
    return elf[:148].ljust(1 << 16, b"\0")


# The command, what is made of the reference's file, and words of the sentence. Files of Intel HEX,
# and commands that need no firmware, are in tests/transcripts/wrong_use.txt.
ROWS: list[tuple[str, Callable[[bytes], bytes], str]] = [
    (CONFORM, lambda elf: elf[:200], "is cut off or damaged"),
    (CONFORM, lambda elf: elf[:18] + b"\x28" + elf[19:], "is not for an AVR, which is all that"),
    (CONFORM, lambda elf: elf[:44] + bytes(2) + elf[46:], "puts nothing into the flash"),
    (CONFORM, lambda elf: elf[:64] + b"\x00\x7f\0\0" + elf[68:], "bytes of flash"),
    (f"{SERVE} --listen nowhere", bytes, "the address is 'nowhere', allowed is HOST:PORT"),
    (f"{SERVE} --pty --probe-listen {{taken}}", bytes, "is in use by another program"),
    ("simulate --firmware no\x1b[31mne.elf", bytes, "cannot be read (No such file or directory)"),
    (SERVE, empty, "crashes before it begins: check that the file is complete"),
]


@pytest.mark.parametrize(("line", "content", "words"), ROWS)
def test_wrong_use_is_one_sentence(
    tmp_path: Path, line: str, content: Callable[[bytes], bytes], words: str
) -> None:
    file = tmp_path / "a.elf"
    file.write_bytes(content(built().read_bytes()))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        taken = f"127.0.0.1:{listener.getsockname()[1]}"
        result = command(*line.format(file=file, taken=taken).split())

    assert (result.returncode, result.stdout) == (2, b"")
    assert len(result.stderr.splitlines()) == 1
    assert words in sentence(result)
    assert b"\x1b" not in result.stderr
