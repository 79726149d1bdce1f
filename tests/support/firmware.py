"""Builds the reference firmware for tests, once for each set of planted bugs and switches."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import pytest

from bilprov.analyzer.client.operations import Listen, Observation, Observe, Received, Send
from bilprov.captures.schemas import MS, Look
from bilprov.conformance.dut.boards.simavr import SimavrBoard
from bilprov.conformance.dut.target import VirtualLink
from tests.support import ROOT
from tests.support.robots import BYTE_TIME

FIRMWARE = ROOT / "firmware"
BUGS = re.findall(r"^#ifndef (BUG_\w+)$", (FIRMWARE / "bugs.h").read_text(), re.MULTILINE)


def _has_simavr() -> bool:
    try:
        ctypes.CDLL("libsimavr.so.2")
    except OSError:
        return False
    return True


def needs(
    *programs: str, files: Sequence[Path] = (), simavr: bool = False, package: str
) -> pytest.MarkDecorator:
    """Skips where a program, a file or libsimavr is not installed, with the line that brings it."""
    missing = [p for p in programs if shutil.which(p) is None]
    missing += [str(file) for file in files if not file.exists()]
    missing += ["libsimavr"] if simavr and not _has_simavr() else []
    reason = f"no {', '.join(missing)}: apt-get install {package}"
    return pytest.mark.skipif(bool(missing), reason=reason)


AVR = needs("avr-gcc", "make", simavr=True, package="make gcc-avr avr-libc simavr")


def make(out: Path, target: str, *words: str) -> None:
    """Build a target into a folder by the firmware's own Makefile."""
    bilprov = f"{sys.executable} -m bilprov"
    fixed = ["make", "-s", "-C", str(FIRMWARE), target, f"OUT={out}", f"BILPROV={bilprov}"]
    done = subprocess.run(
        [*fixed, *words],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
    )
    assert done.returncode == 0, done.stderr


@cache
def _header() -> Path:
    """The C header of the grammar, which every firmware includes."""
    out = Path(tempfile.mkdtemp(prefix="bilprov-firmware-"))
    make(out, f"{out}/protocol.h")
    return out / "protocol.h"


@cache
def built(switches: str = "", target: str = "uno") -> Path:
    """The ELF file, built once with these `-D` switches."""
    out = Path(tempfile.mkdtemp(prefix="bilprov-firmware-"))
    shutil.copy2(_header(), out)
    make(out, target, f"BUGS={switches}")
    return out / f"{target}.elf"


class Bench:
    """A board on a virtual line: what is sent to it, what it answers, what its pins do.

    It is not closed: its memory goes with the process.
    """

    def __init__(self, firmware: Path) -> None:
        self.board = SimavrBoard(firmware)
        self._link = VirtualLink(self.board, BYTE_TIME)

    @property
    def now(self) -> int:
        """The board's time (ns)."""
        return self._link.now

    def send(self, data: bytes, *, wait: int = 5 * MS, answers: int | None = 1) -> bytes:
        """The answers to some bytes, listened for at most so long (ns)."""
        self._link.do(Send(data))
        heard = self._link.do(Listen(answers, wait))
        assert isinstance(heard, Received)
        return bytes(heard.codes)

    def look(self) -> Look:
        """What the pins and the PWM registers say."""
        seen = self._link.do(Observe())
        assert isinstance(seen, Observation)
        return seen.look


def record(offset: int, kind: int, data: bytes) -> str:
    """A line of Intel HEX."""
    raw = bytes([len(data), offset >> 8, offset & 0xFF, kind]) + data
    return f":{(raw + bytes([-sum(raw) & 0xFF])).hex().upper()}\n"


END = record(0, 1, b"")


@cache
def compiled(source: str, *words: str) -> Path:
    """The ELF file of a program for the board's chip; `words` are more options of the compiler."""
    folder = Path(tempfile.mkdtemp(prefix="bilprov-firmware-"))
    (folder / "a.c").write_text(source)
    fixed = ["avr-gcc", "-mmcu=atmega328p", "-DF_CPU=16000000UL", "-Os", "-o", "a.elf", "a.c"]
    subprocess.run([*fixed, *words], cwd=folder, check=True)
    return folder / "a.elf"
