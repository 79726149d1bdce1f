"""A board under QEMU: a process of its own in real time, reached by its line and its monitor.

The machine is chosen by the file's own type; the robot's state is found in RAM by its magic number.
"""

from __future__ import annotations

import contextlib
import json
import re
import select
import shutil
import socket
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from captures.schemas import Look
from conformance.boards.elf import ARM, AVR, architecture
from conformance.boards.emulator import EmulatorError
from conformance.probes import ProbeError

_PATIENCE = 10.0  # s until it must run


@dataclass(frozen=True, slots=True)
class _Machine:
    """One that QEMU emulates: how it is started, and where its RAM lies."""

    program: str
    options: tuple[str, ...]
    ram: int
    size: int
    package: str


_MACHINES = {
    AVR: _Machine("qemu-system-avr", ("-M", "uno", "-bios"), 0x800100, 0x800, "qemu-system-misc"),
    ARM: _Machine(
        "qemu-system-arm", ("-M", "lm3s6965evb", "-kernel"), 0x20000000, 0x1000, "qemu-system-arm"
    ),
}
"""By the ELF file's number for the architecture."""

# struct robot_state of firmware/robot.h
_MAGIC = struct.pack("<I", 0x42494C21)
_STATE = struct.Struct("<IBBhhhB")
_MOTIONS = ("stopped", "forward", "backward", "rotate_right", "rotate_left")
_WORD = re.compile(r"0x([0-9a-f]{2})\b")


class QemuBoard:
    """A board that runs while the context is open: `url` is its line; it is its own probe.

    Raises EmulatorError, in one sentence, where QEMU is missing or does not take the file.
    """

    sparse = False
    patience = 1.0

    def __init__(self, firmware: Path) -> None:
        self._machine = _machine_of(firmware)
        self._firmware = firmware
        self._held = b""
        self._at: int | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        machine = self._machine
        program = shutil.which(machine.program)
        if program is None:
            raise EmulatorError(
                f"{machine.program} is not installed: apt-get install {machine.package}"
            )
        with socket.create_server(("127.0.0.1", 0)) as line:
            mine, theirs = socket.socketpair()
            with theirs:
                self._monitor = mine
                self.url = f"socket://127.0.0.1:{line.getsockname()[1]}"
                words = [program, *machine.options, str(self._firmware), "-display", "none"]
                words += ["-chardev", f"socket,id=line,fd={line.fileno()},server=on,wait=off"]
                words += ["-chardev", f"socket,id=monitor,fd={theirs.fileno()}"]
                words += ["-serial", "chardev:line", "-mon", "chardev=monitor,mode=control"]
                self._process = subprocess.Popen(
                    words,
                    pass_fds=(line.fileno(), theirs.fileno()),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.PIPE,
                )
        try:
            self._reply()  # its greeting
            self._command("qmp_capabilities")
            self._find()
        except (EmulatorError, ProbeError):
            self.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    # -- the probe --------------------------------------------------------------------------------

    def ask(self) -> None:
        """Ask for the robot's state in RAM."""
        assert self._at is not None
        self._send("human-monitor-command", _dump(self._at, _STATE.size))

    def fileno(self) -> int:
        """The monitor's socket."""
        return self._monitor.fileno()

    def take(self, now: int) -> Look | None:
        """The look, once the monitor's line is complete."""
        reply = self._next()
        if reply is None:
            return None
        data = _bytes_of(str(reply.get("return", "")))
        if len(data) < _STATE.size or not data.startswith(_MAGIC):
            raise ProbeError("the emulator's RAM no longer holds the robot's state")
        _, motion, speed, steering, left, right, led = _STATE.unpack(data[: _STATE.size])
        visible = _MOTIONS[motion] if motion < len(_MOTIONS) else "unknown"
        moving = bool(left or right)
        return Look(
            t=now,
            moving=moving,
            motion=visible if moving else "stopped",
            speed=speed,
            steering=steering,
            led=led,
            left=left,
            right=right,
        )

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(5)
            if self._process.stderr:
                self._process.stderr.close()
            self._process = None
            self._monitor.close()

    # -- the monitor ------------------------------------------------------------------------------

    def _find(self) -> None:
        """Look for the magic number until the firmware has written it."""
        machine = self._machine
        for _ in range(200):
            text = self._command("human-monitor-command", **_dump(machine.ram, machine.size))
            at = _bytes_of(str(text)).find(_MAGIC)
            if at >= 0:
                self._at = machine.ram + at
                return
            select.select([], [], [], _PATIENCE / 200)
        raise EmulatorError(
            f"{self._firmware} runs, but its RAM holds no robot's state (struct robot_state)"
        )

    def _command(self, name: str, **arguments: str) -> Any:
        self._send(name, arguments)
        return self._reply().get("return")

    def _send(self, name: str, arguments: dict[str, str]) -> None:
        order: dict[str, Any] = {"execute": name}
        if arguments:
            order["arguments"] = arguments
        try:
            self._monitor.sendall(json.dumps(order).encode() + b"\n")
        except OSError as error:
            raise ProbeError(f"the emulator has ended ({error.strerror})") from error

    def _reply(self) -> dict[str, Any]:
        while True:
            ready = select.select([self._monitor], [], [], _PATIENCE)[0]
            if not ready:
                raise EmulatorError(f"{self._machine.program} does not answer")
            reply = self._next()
            if reply is not None:
                return reply

    def _next(self) -> dict[str, Any] | None:
        """The next reply, None while its line is not complete; events are passed over."""
        data = self._monitor.recv(1 << 16)
        if not data:
            raise EmulatorError(f"{self._machine.program} ended: {self._last_words()}")
        self._held += data
        while b"\n" in self._held:
            line, _, self._held = self._held.partition(b"\n")
            reply = json.loads(line)
            if "event" not in reply:
                return dict(reply)
        return None

    def _last_words(self) -> str:
        if self._process is None or self._process.stderr is None:
            return "unknown why"
        self._process.wait(5)
        words = self._process.stderr.read().decode(errors="replace").strip()
        return words.splitlines()[-1] if words else f"exit {self._process.returncode}"


def _machine_of(firmware: Path) -> _Machine:
    number = architecture(firmware)
    if number not in _MACHINES:
        raise EmulatorError(f"{firmware} is neither for an AVR nor for an ARM: QEMU runs these two")
    return _MACHINES[number]


def _dump(address: int, count: int) -> dict[str, str]:
    return {"command-line": f"xp /{count}xb {address:#x}"}


def _bytes_of(text: str) -> bytes:
    """The bytes of a dump: an address and a colon, then bytes, on each line."""
    found = (_WORD.findall(line.partition(":")[2]) for line in text.splitlines())
    return bytes(int(word, 16) for words in found for word in words)
