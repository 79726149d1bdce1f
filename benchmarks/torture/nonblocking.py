"""Standard output is a pipe that does not block, as node or ssh leave it, and nobody reads a while.

Each command runs twice, on a pipe that blocks and on one that does not. Both are full when it
begins, and are read from a moment on that the seed draws. What it shows and its exit code must be
the same, and a recording whole.
"""

from __future__ import annotations

import fcntl
import os
import re
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from random import Random
from signal import SIGINT
from typing import NamedTuple

from benchmarks.commands import bilprov_words, started
from benchmarks.torture.exits import drive_capture, items
from benchmarks.torture.harm import Harm, Progress, Row
from benchmarks.torture.robots import served
from benchmarks.torture.unplugged_taps import Plug, Talk, heard, until
from bilprov.captures.errors import CaptureError

_PAGE = 4096  # bytes, the least that a pipe holds
_STALLED = (0.5, 2.0)  # s that nobody reads
_STALLED_DRIVING = (0.2, 0.6)  # s that nobody reads once it drives; an answer is awaited longer
_PATIENCE = 60.0  # s
_SLOW = 0.001  # s between two reads
_FRAMES = 300  # instructions that sniff hears
_STEP = 0.002  # s between them
_TIMES = re.compile(
    rb"answered after .* is the deadline|begun .*|\d[\d.:T+-]* *(?:ms|s|times)\b|-?\d+\.\d{3,}"
    rb"|/dev/pts/\d+|/tmp/\w+"
)
"""What differs from run to run: times, and names of ports and folders."""


class Shown(NamedTuple):
    """What a command showed, without times, and how it ended; what was lost of its recording."""

    output: bytes
    code: int | None
    told: str
    lost: str = ""
    left_moving: bool = False


class Pipe:
    """A pipe that is full, whose reader stalls for a while; `end` is to be written to."""

    def __init__(self, *, blocking: bool) -> None:
        self._reader, self.end = os.pipe()
        fcntl.fcntl(self.end, fcntl.F_SETPIPE_SZ, _PAGE)
        os.write(self.end, bytes(_PAGE))
        os.set_blocking(self.end, blocking)
        self.taken = bytearray()
        self._thread = threading.Thread(target=self._read)

    def read_on(self) -> None:
        """Begin to read; from now on the end is the other program's alone."""
        os.close(self.end)
        self._thread.start()

    def _read(self) -> None:
        while data := os.read(self._reader, 1024):
            self.taken += data
            time.sleep(_SLOW)

    def all(self) -> bytes:
        """What was written, once all programs have closed the end."""
        self._thread.join()
        os.close(self._reader)
        return bytes(self.taken[_PAGE:])


class Command(NamedTuple):
    """A command: its words for a port and a folder, and whether it drives a robot or listens."""

    words: Callable[[str, Path], list[str]]
    drives: bool = False
    listens: bool = False


def _plain(*words: str) -> Command:
    return Command(lambda port, folder: bilprov_words(*words))


def _sniff(port: str, folder: Path) -> list[str]:
    taps = [str(folder / name) for name in ("host", "device")]
    return bilprov_words(
        *("sniff", *taps, "-w", str(folder / "run.mcap"), "--plain", "--columns", "hex")
    )


COMMANDS = {
    "conform -v": _plain("conform", "sim", "--level", "smoke", "-v"),
    "conform -v, faulty": _plain(
        *("conform", "sim", "--level", "smoke", "-v", "--fault", "always-1")
    ),
    "conform --list": _plain("conform", "sim", "--list"),
    "sniff -w": Command(_sniff, listens=True),
    "send": Command(
        lambda port, folder: bilprov_words("send", port, *items(pause="pause=100"), "--yes"),
        drives=True,
    ),
    "replay": Command(
        lambda port, folder: bilprov_words("replay", str(drive_capture(folder)), "--rate", "0")
    ),
    "export": Command(
        lambda port, folder: bilprov_words(
            *("export", str(drive_capture(folder)), "--format", "csv", "-o", "-")
        )
    ),
    "simulate --list-faults": _plain("simulate", "--list-faults"),
}


def shown(name: str, seed: int, *, blocking: bool) -> Shown:
    """Run a command on a pipe that nobody reads for a while."""
    command, draw = COMMANDS[name], Random(f"{seed} {name}")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        robot = stack.enter_context(served()) if command.drives else None
        at_first = robot.probe.look() if robot else {}
        errors = stack.enter_context(tempfile.TemporaryFile())
        plugs = [Plug(folder / side) for side in ("host", "device")] if command.listens else []
        for plug in plugs:
            stack.callback(plug.pull)
        pipe = Pipe(blocking=blocking)
        words = command.words(robot.port if robot else "", folder)
        process = stack.enter_context(started(words, stdout=pipe.end, stderr=errors))
        lost = ""
        if command.listens:
            lost = _recorded(process, plugs, folder / "run.mcap", Talk(draw), pipe)
        else:
            if robot:
                until(lambda: robot.probe.look() != at_first or process.poll() is not None, "rests")
            time.sleep(draw.uniform(*(_STALLED_DRIVING if robot else _STALLED)))
            pipe.read_on()
        try:
            code: int | None = process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            code = None
            process.kill()
        lines = [b" ".join(line.split()) for line in _TIMES.sub(b"#", pipe.all()).splitlines()]
        # Of two taps, which is read first is a matter of chance.
        output = b"\n".join(sorted(lines) if command.listens else lines)
        errors.seek(0)
        told = errors.read().decode(errors="replace")
        return Shown(output, code, told, lost, robot is not None and robot.probe.moving)


def _recorded(
    process: subprocess.Popen[bytes], plugs: list[Plug], capture: Path, talk: Talk, pipe: Pipe
) -> str:
    """Give `sniff` traffic while nobody reads, then read and end it; what it lost of that."""
    until(lambda: capture.exists() or process.poll() is not None, "no capture")
    time.sleep(0.3)  # for the ports, which are opened about then
    host, device = plugs
    for _ in range(_FRAMES):
        frame, answer = talk.next()
        host.write(frame)
        talk.wrote("host", frame)
        device.write(answer)
        talk.wrote("device", answer)
        time.sleep(_STEP)
    pipe.read_on()

    def whole() -> bool:
        with suppress(CaptureError):  # it has just been made
            return heard(capture) == talk.written
        return False

    with suppress(TimeoutError):
        until(lambda: whole() or process.poll() is not None, "not all is captured")
    process.send_signal(SIGINT)
    if whole():
        return ""
    kept = {side: len(data) for side, data in heard(capture).items()}
    return f"recorded are {kept} bytes of { ({side: len(d) for side, d in talk.written.items()}) }"


def differs(name: str, seed: int) -> str:
    """What a command does otherwise on a pipe that does not block, "" if nothing."""
    usual, other = (shown(name, seed, blocking=blocking) for blocking in (True, False))
    last = other.told.strip()[-200:]
    wrong = [other.lost] if other.lost else []
    if other.left_moving:
        wrong.append("left moving")
    if other.code != usual.code:
        wrong.append(f"exit {other.code}, and {usual.code} on a pipe that blocks")
    if other.output != usual.output:
        wrong.append(f"{len(other.output)} bytes shown of {len(usual.output)}")
    if usual.lost or usual.code is None:
        wrong.append(f"on a pipe that blocks: exit {usual.code}, {usual.lost}")
    return (wrong and f"{name}, seed {seed}: {'; '.join(wrong)}: {last}") or ""


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    """Run every command so often on both pipes; a row for each."""
    wrong: dict[str, list[str]] = {name: [] for name in COMMANDS}
    for turn in range(seed, seed + runs):
        for name in COMMANDS:
            wrong[name].append(differs(name, turn))
        progress(1)
    return [_row(name, tuple(filter(None, came)), runs) for name, came in wrong.items()]


def _row(name: str, wrong: tuple[str, ...], runs: int) -> Row:
    told = f"{len(wrong)} showed or recorded less, or ended otherwise, than on one that blocks"
    return Row(f"`{name}` on a pipe that does not block and is not read", runs, told, wrong)


HARM = Harm("nonblocking", "outputs that do not block, and readers that stall", 5, _measure)
