"""Firmware that cannot be run, and options that do not go with it: one sentence, and no crash."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.commands import command
from tests.support.firmware import AVR, END, built, record
from tests.support.robots import sentence

pytestmark = [pytest.mark.waits, AVR]

CONFORM, SERVE = "conform emulator:simavr:{file} --level smoke", "simulate --firmware {file}"
TEXT, HEX = b"no firmware", (record(0, 0, b"abcd") + END).encode()
Content = bytes | str | Callable[[bytes], bytes]


def empty(elf: bytes) -> bytes:
    """An ELF file with its headers, and no instruction but "do nothing"."""
    return elf[:148].ljust(1 << 16, b"\0")


# The command, what is in its file (or what is made of the reference's), and words of the sentence.
ROWS: list[tuple[str, Content, str]] = [
    (CONFORM, lambda elf: elf[:200], "is cut off or damaged"),
    (CONFORM, b"", "is not an ELF file: give the one that the linker wrote"),
    (CONFORM, lambda elf: elf[:18] + b"\x28" + elf[19:], "is not for an AVR, which is all that"),
    (CONFORM, lambda elf: elf[:44] + bytes(2) + elf[46:], "puts nothing into the flash"),
    (CONFORM, lambda elf: elf[:64] + b"\x00\x7f\0\0" + elf[68:], "bytes of flash"),
    ("conform emulator:foo:x.elf", b"", "names no board"),
    ("conform emulator:simavr", b"", "names no board"),
    ("conform emulator:simavr:none.elf", b"", "there is no firmware none.elf"),
    ("conform emulator:simavr:.", b"", ". cannot be read (Is a directory)"),
    ("conform emulator:qemu:{file}", TEXT, "write emulator:simavr:FIRMWARE.elf"),
    (f"{CONFORM} --probe none", TEXT, "brings its own probe"),
    (f"{CONFORM} --fault dead", TEXT, "--fault is for the target sim"),
    (f"{CONFORM} --power exec:true", TEXT, "is for ports"),
    (SERVE, record(0, 0, b"abcd"), "is cut off: its last record is missing"),
    (SERVE, END, "puts nothing into the flash"),
    (
        SERVE,
        record(0x7FFE, 0, b"abcd") + END,
        "needs 32770 bytes of flash, and the board has 32768",
    ),
    (SERVE, record(0, 0, b"abcd")[:-3] + "\n" + END, "damaged in line 1"),
    (SERVE, record(0, 0, b"abcd") + "no record\n" + END, "damaged in line 2"),
    (SERVE, record(0, 3, b"\0\0\x7c\0") + record(0, 0, b"ab") + END, "instruction at 0x7c00"),
    (f"{SERVE} --start boot", HEX, "write it like 0x7c00 or 31744"),
    (f"{SERVE} --start 0x7f00", HEX, "no instruction at 0x7f00"),
    (f"--grammar stk500v1 {SERVE} --probe-listen 127.0.0.1:0", HEX, "leave out --probe-listen"),
    (f"{SERVE} --fault always-0", bytes, "--fault is for the simulated robot car and its family"),
    (f"{SERVE} {{file}}", bytes, "got unexpected extra argument"),
    (f"{SERVE} --listen nowhere", bytes, "the address is 'nowhere', allowed is HOST:PORT"),
    (f"{SERVE} --pty --probe-listen {{taken}}", bytes, "is in use by another program"),
    ("simulate --firmware no\x1b[31mne.elf", b"", "cannot be read (No such file or directory)"),
    (SERVE, empty, "crashes before it begins: check that the file is complete"),
]


@pytest.mark.sample(12)
@pytest.mark.parametrize(("line", "content", "words"), ROWS)
def test_wrong_use_is_one_sentence(tmp_path: Path, line: str, content: Content, words: str) -> None:
    file = tmp_path / "a.elf"
    made = content(built().read_bytes()) if callable(content) else content
    file.write_bytes(made.encode() if isinstance(made, str) else made)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        taken = f"127.0.0.1:{listener.getsockname()[1]}"
        result = command(*line.format(file=file, taken=taken).split())

    assert (result.returncode, result.stdout) == (2, b"")
    assert len(result.stderr.splitlines()) == 1
    assert words in sentence(result)
    assert b"\x1b" not in result.stderr
