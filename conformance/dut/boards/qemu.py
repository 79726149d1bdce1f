"""An emulated board in a QEMU process, in real time: its serial line and its monitor (QMP).

The ELF file's architecture selects the machine; the robot's state is found in RAM by its magic
number.
"""

from __future__ import annotations

import contextlib
import shutil
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import open_port
from bilprov.captures.schemas import Look
from bilprov.conformance.dut.boards import EmulatorError
from bilprov.conformance.dut.boards.elf import ARM, AVR, architecture
from bilprov.conformance.dut.boards.qmp import Monitor
from bilprov.conformance.dut.port_link import PowerError
from bilprov.conformance.dut.probes import Probe, ProbeError
from bilprov.spec.motion import Motion

_PATIENCE = 10.0  # s until the firmware must run, and the line must be opened
_STEP = 0.02  # s between two checks whether it runs


@dataclass(frozen=True, slots=True)
class _Machine:
    """A machine that QEMU emulates: how it is started, and the address and size of its RAM."""

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
"""The machines by the ELF file's e_machine."""

_GUARD = 'read -r _; kill -KILL "$0"'
"""A shell script that kills a process once its own stdin closes, however the kit ends."""

# struct robot_state of firmware/robot.h
_MAGIC = struct.pack("<I", 0x42494C21)
_STATE = struct.Struct("<IBBhhhB")
_MOTIONS = (
    *(Motion.STOPPED, Motion.FORWARD, Motion.BACKWARD),
    *(Motion.ROTATE_RIGHT, Motion.ROTATE_LEFT),
)


@contextlib.contextmanager
def running(firmware: Path, settings: LineSettings) -> Iterator[tuple[Port, QemuBoard]]:
    """A board that is switched on, with its port open. Raises EmulatorError and LinkError."""
    with contextlib.closing(QemuBoard(firmware)) as board, open_port(board.url, settings) as port:
        board.power_on()
        yield port, board


class QemuBoard(Probe):
    """A board under QEMU: `url` is its serial line, and the board is its own probe.

    It is switched off until the line has been opened and `power_on` is called. Raises
    EmulatorError, in one sentence, where QEMU is missing or does not run the file.
    """

    def __init__(self, firmware: Path) -> None:
        number = architecture(firmware)
        if number not in _MACHINES:
            raise EmulatorError(
                f"{firmware} is neither for an AVR nor for an ARM: QEMU runs these two"
            )
        self._machine = _MACHINES[number]
        program = shutil.which(self._machine.program)
        if program is None:
            raise EmulatorError(
                f"{self._machine.program} is not installed: apt-get install {self._machine.package}"
            )
        self._program = program
        self._firmware = firmware
        self._at = 0
        self._line: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._guard: subprocess.Popen[bytes] | None = None
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(_PATIENCE)
        self.url = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"

    def power_on(self) -> None:
        """Start QEMU on the opened line and wait until the firmware runs. Raises EmulatorError."""
        if self._line is None:
            self._line, _ = self._listener.accept()
            self._line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        mine, theirs = socket.socketpair()
        self._monitor = Monitor(mine)
        line = self._line.fileno()
        with theirs:
            words = [self._program, *self._machine.options, str(self._firmware)]
            words += ["-display", "none", "-chardev", f"socket,id=line,fd={line}"]
            words += ["-chardev", f"socket,id=monitor,fd={theirs.fileno()}"]
            words += ["-serial", "chardev:line", "-mon", "chardev=monitor,mode=control"]
            self._process = subprocess.Popen(
                words,
                pass_fds=(line, theirs.fileno()),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
            )
        self._guard = subprocess.Popen(
            ["/bin/sh", "-c", _GUARD, str(self._process.pid)],
            stdin=subprocess.PIPE,
            start_new_session=True,  # a Ctrl-C, or the terminal's end, is not for the guard
        )
        threading.Thread(target=self._watch, args=(self._process,), daemon=True).start()
        try:
            self._monitor.greet()
            self._at = self._found()
        except EmulatorError as error:
            self._process.terminate()
            raise EmulatorError(self._last_words() or str(error)) from error

    def power_cycle(self) -> None:
        """Switch the board off and on: a new process on the same line. Raises PowerError."""
        self._power_off()
        assert self._line is not None
        with contextlib.suppress(BlockingIOError):  # bytes it has not read are lost
            while self._line.recv(1 << 16, socket.MSG_DONTWAIT):
                pass
        try:
            self.power_on()
        except EmulatorError as error:
            raise PowerError(f"the emulator did not start again: {error}") from error

    # -- the probe --------------------------------------------------------------------------------

    def ask(self) -> None:
        """Request the robot's state from RAM. Raises ProbeError."""
        try:
            self._monitor.ask_dump(self._at, _STATE.size)
        except EmulatorError as error:
            raise ProbeError(str(error)) from error

    def fileno(self) -> int:
        """The monitor's socket."""
        return self._monitor.fileno()

    def take(self, now: int) -> Look | None:
        """The look, as of `now` (ns), once the monitor's reply is complete. Raises ProbeError."""
        try:
            data = self._monitor.take_dump()
        except EmulatorError as error:
            raise ProbeError(str(error)) from error
        if data is None:
            return None
        if len(data) != _STATE.size or not data.startswith(_MAGIC):
            raise ProbeError("the emulator's RAM no longer holds the robot's state")
        _, motion, speed, steering, left, right, led = _STATE.unpack(data)
        moving = bool(left or right)
        told = _MOTIONS[motion].value if motion < len(_MOTIONS) else "unknown"
        return Look(
            t=now,
            moving=moving,
            motion=told if moving else Motion.STOPPED.value,
            speed=speed,
            steering=steering,
            led=led,
            left=left,
            right=right,
        )

    def close(self) -> None:
        """End QEMU and close the line; further calls do nothing."""
        self._power_off()
        if self._line is not None:
            self._line.close()
        self._listener.close()

    # -- inside -----------------------------------------------------------------------------------

    def _found(self) -> int:
        """The address of the robot's state in RAM; waits until its magic number is there."""
        machine, until = self._machine, time.monotonic() + _PATIENCE
        while time.monotonic() < until:
            at = self._monitor.dump(machine.ram, machine.size).find(_MAGIC)
            if at >= 0:
                return machine.ram + at
            time.sleep(_STEP)
        raise EmulatorError(
            f"{self._firmware} runs, but its RAM holds no robot's state (struct robot_state)"
        )

    def _power_off(self) -> None:
        guard, self._guard = self._guard, None
        if guard is not None:
            guard.kill()
            guard.communicate()
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            if process.stderr:
                process.stderr.close()
            self._monitor.close()

    def _watch(self, process: subprocess.Popen[bytes]) -> None:
        """Shut the line down if QEMU ends by itself, so that it is not taken for silence."""
        process.wait()
        if process is self._process and self._line is not None:
            with contextlib.suppress(OSError):
                self._line.shutdown(socket.SHUT_RDWR)

    def _last_words(self) -> str:
        """The last line on stderr of the process that has ended, as words; "" if there is none."""
        assert self._process is not None
        assert self._process.stderr is not None
        words = self._process.communicate()[1].decode(errors="replace").strip().splitlines()
        return f"{self._machine.program} ended: {words[-1]}" if words else ""
