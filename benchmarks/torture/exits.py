"""Commands that drive a robot are ended from outside: how often one is left moving. Never.

Each run ends one command in one phase in one way, drawn by the seed, while it drives
`bilprov simulate` over a relay, and asks the probe afterwards. SIGKILL is not among the ways:
nothing that a program does can follow it.
"""

from __future__ import annotations

import fcntl
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import termios
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from random import Random
from typing import NamedTuple

from benchmarks.torture.harm import Harm, Progress, Row
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.replay.recorder import session_metadata
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.pty import PtyPair, open_pty
from bilprov.analyzer.transport.streams import parse_address
from bilprov.captures.schemas import MS, Chunk
from bilprov.captures.writer import CaptureWriter
from bilprov.conformance.cases.preamble import frames_to, full_state
from bilprov.spec.by_effect import movers
from bilprov.spec.fields import Outcome

_PATIENCE = 90.0  # s until a command that was ended must have ended
_REACHED = 30.0  # s for a phase to come
_QUIET = 0.03  # s without a byte: a pause
_SLOW = 0.01  # s a byte takes on a port whose other end reads slowly
_LATE = (300, 2500)  # bytes of a run with a failure, which is tried again and minimised


def _moving_frames() -> tuple[bytes, ...]:
    protocol = load_protocol()
    return frames_to(protocol, full_state(protocol, next(iter(movers(protocol)))))


def items(*, pause: str) -> list[str]:
    """What sets a robot moving and lets it drive, as `send` takes it."""
    return [*(frame.hex() for frame in _moving_frames()), pause] * 4


class Line:
    """A relay between a command and the simulator: counts, holds back answers, reads slowly."""

    def __init__(self, port: str) -> None:
        self.sent = 0
        """Bytes that the command has sent."""
        self.last = time.monotonic()
        """When the last byte passed (s)."""
        self.withheld = self.slow = False
        self._near: PtyPair = open_pty()
        self.name = self._near.name
        self._far = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self._over = False
        self._thread = threading.Thread(target=self._relay, daemon=True)
        self._thread.start()

    def _relay(self) -> None:
        while not self._over:
            ready, _, _ = select.select([self._near.master, self._far], [], [], 0.02)
            with suppress(OSError):
                if self._near.master in ready:
                    data = os.read(self._near.master, 1 if self.slow else 1 << 12)
                    self.sent += len(data)
                    self.last = time.monotonic()
                    os.write(self._far, data)
                    time.sleep(_SLOW * self.slow)
                if self._far in ready:
                    data = os.read(self._far, 1 << 12)
                    self.last = time.monotonic()
                    if not self.withheld:
                        os.write(self._near.master, data)

    def drained(self) -> None:
        """Wait until all that the command has sent has arrived."""
        while select.select([self._near.master], [], [], 0)[0] or self.quiet < 2 * _QUIET:
            time.sleep(0.01)

    @property
    def quiet(self) -> float:
        """For how long (s) no byte has passed."""
        return time.monotonic() - self.last

    def close(self) -> None:
        """End the relay."""
        self._over = True
        self._thread.join()
        os.close(self._far)
        self._near.close()


class Probe:
    """What the simulator's probe tells."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.seen = False
        """Whether it moved when it was looked at last."""
        self._socket = socket.create_connection(parse_address(name.removeprefix("tcp:")), 30)
        self._answers = self._socket.makefile("rb")

    @property
    def moving(self) -> bool:
        """Whether the robot moves now."""
        self._socket.sendall(b"state\n")
        self.seen = bool(json.loads(self._answers.readline())["moving"])
        return self.seen

    def close(self) -> None:
        """Hang up."""
        self._answers.close()
        self._socket.close()


class Command(NamedTuple):
    """A command: its words for a port, a probe and a folder; what is typed; its robot's fault."""

    words: Callable[[str, str, Path], list[str]]
    typed: str = ""
    fault: str = ""


_DRIVE = """
import sys, time
from bilprov import Robot
with Robot(sys.argv[1]) as robot:
    for turn in range(20):
        for frame in sys.argv[2:]:
            robot.send_bytes(bytes.fromhex(frame))
        time.sleep(0.2)
        {}
"""


def _driver(last: str) -> Command:
    frames = [frame.hex() for frame in _moving_frames()]
    script = _DRIVE.format(last)
    return Command(lambda port, probe, folder: [sys.executable, "-c", script, port, *frames])


def _bilprov(name: str, *more: str, typed: str = "", fault: str = "") -> Command:
    """A command that has a port and no probe."""
    words = [sys.executable, "-m", "bilprov", name]
    return Command(lambda port, probe, folder: [*words, port, *more], typed, fault)


def _seeing(name: str, *more: str, typed: str = "", fault: str = "") -> Command:
    """A command that has a port and a probe."""
    words, rest = [sys.executable, "-m", "bilprov", *name.split()], ["--yes", *more]
    return Command(
        lambda port, probe, folder: [*words, port, "--probe", probe, *rest], typed, fault
    )


def _plugin(port: str, probe: str, folder: Path) -> list[str]:
    options = ["--robot-port", port, "--robot-probe", probe, "--robot-yes"]
    alone = ["-p", "no:cacheprovider", "--rootdir", str(folder)]
    return [sys.executable, "-m", "pytest", "-q", *alone, *options]


def _replay(port: str, probe: str, folder: Path) -> list[str]:
    words = [sys.executable, "-m", "bilprov", "replay"]
    return [*words, str(drive_capture(folder)), "--to", port, "--yes"]


def drive_capture(folder: Path) -> Path:
    """A recording in which a robot drives with pauses."""
    path = folder / "drive.mcap"
    protocol = load_protocol()
    about = session_metadata(
        protocol,
        ports={},
        line=str(line_settings(protocol, None, None, None)),
        timeout=50 * MS,
        skew=0,
        heard=("host", "device"),
    )
    code = protocol.answers[Outcome.VALID].code
    with CaptureWriter(path, start_wall=time.time_ns(), metadata=about, version="0") as out:
        for turn, (number, frame) in product(range(20), enumerate(_moving_frames())):
            t = turn * 300 * MS + number * 10 * MS
            out.chunk(Chunk(t, "host", frame))
            out.chunk(Chunk(t + MS, "device", bytes([code])))
    return path


EXAMINES = "ports --ask"
COMMANDS = {
    "conform": _seeing("conform", "--level", "smoke"),
    "conform, faulty": _seeing(
        "conform", *("--only", "split/*"), *("--only", "valid/*"), fault="led-order-reversed"
    ),
    "send": _bilprov("send", *items(pause="pause=300"), "--yes"),
    "send, typed": _seeing("send", typed="\n".join(items(pause="pause=300")) + "\n"),
    "replay --to": Command(_replay),
    "lab learn": _seeing("lab learn"),
    EXAMINES: _bilprov("ports", "--ask", "--yes", "--seconds", "0.2"),
    "plugin": Command(_plugin),
    "Robot": _driver("pass"),
    "Robot, exception": _driver("assert turn < 2"),
}


class Run(NamedTuple):
    """A command that runs: its process, line and probe, and the terminal or pipes that it has."""

    process: subprocess.Popen[bytes]
    line: Line
    probe: Probe
    hang_up: Callable[[], None]
    draw: Random


def _wait(run: Run, what: Callable[[], bool]) -> None:
    """Wait for something, or for the command's end."""
    until = time.monotonic() + _REACHED
    while not what() and run.process.poll() is None and time.monotonic() < until:
        time.sleep(0.002)


def _moves(run: Run) -> None:
    _wait(run, lambda: run.probe.moving)
    time.sleep(run.draw.choice((0, 0.002, 0.03)))


def _waits(run: Run) -> None:
    _wait(run, lambda: run.probe.moving)
    run.line.withheld = True
    time.sleep(run.draw.choice((0, 0.01, 0.1)))


def _reports(run: Run) -> None:
    _wait(run, lambda: run.probe.moving)
    _wait(run, lambda: run.line.quiet > 0.2 and not run.probe.moving)


def _is_late(run: Run) -> None:
    bytes_sent = run.draw.randint(*_LATE)
    _wait(run, lambda: run.line.sent >= bytes_sent)


PHASES: dict[str, Callable[[Run], None]] = {
    # Python itself may lose a SIGINT until it has begun with the command.
    "before the first byte": lambda run: time.sleep(run.draw.uniform(0.1, 0.5)),
    "homing": lambda run: _wait(run, lambda: run.line.sent > 0),
    "while moving": _moves,
    "in a pause": lambda run: _wait(run, lambda: run.line.quiet > _QUIET and run.probe.moving),
    "waiting for an answer": _waits,
    "late in the run": _is_late,
    "while reporting": _reports,
}


def _signals(*numbers: signal.Signals) -> Callable[[Run], None]:
    def send(run: Run) -> None:
        for number in numbers:
            run.process.send_signal(number)
            time.sleep(run.draw.choice((0, 0.0005, 0.005, 0.03)))

    return send


def _slow(run: Run) -> None:
    run.line.slow = True
    run.process.send_signal(signal.SIGTERM)


def _broken_pipe(run: Run) -> None:
    run.hang_up()
    with suppress(subprocess.TimeoutExpired):
        run.process.wait(2)
    run.process.terminate()


_SIGINT = signal.SIGINT
WAYS: dict[str, Callable[[Run], None]] = {
    "SIGINT": _signals(_SIGINT),
    "SIGTERM": _signals(signal.SIGTERM),
    "SIGHUP": _signals(signal.SIGHUP),
    "SIGINT twice": _signals(_SIGINT, _SIGINT),
    "SIGINT four times": _signals(_SIGINT, _SIGINT, _SIGINT, _SIGINT),
    "SIGTERM after SIGINT": _signals(_SIGINT, signal.SIGTERM),
    "broken pipe": _broken_pipe,
    "hang-up": lambda run: run.hang_up(),
    "SIGTERM, slow reader": _slow,
}

Case = tuple[str, str, str]

CASES: tuple[Case, ...] = tuple(
    row
    for row in product(COMMANDS, PHASES, WAYS)
    if row[0] != EXAMINES or row[1] in ("before the first byte", "homing")
)
"""Each command, phase and way; `ports --ask` sends no motion, so it has two phases only."""


@dataclass(frozen=True, slots=True)
class Exit:
    """What one run came to: whether the robot moved when it began to end, and was left moving."""

    case: Case
    moved: bool
    left_moving: bool
    hung: bool
    lost: bool = False
    """Whether Python itself lost the signal while it started."""
    told: str = ""

    @property
    def held(self) -> bool:
        """Whether all is as it must be."""
        return not (self.left_moving or self.hung)


def ended(case: Case, seed: int) -> Exit:
    """Run a command, end it in that phase in that way, and see what the robot does then."""
    command, draw = COMMANDS[case[0]], Random(f"{seed} {case}")
    fault = ["--fault", command.fault] if command.fault else []
    words = [sys.executable, "-m", "bilprov", "simulate", "--probe-listen", "127.0.0.1:0", *fault]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        served = stack.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE, text=True))
        stack.callback(served.terminate)
        assert served.stdout is not None
        port, probe_name = (served.stdout.readline().strip() for _ in range(2))
        line = Line(port)
        stack.callback(line.close)
        probe = Probe(probe_name.removeprefix("probe "))
        stack.callback(probe.close)
        told = stack.enter_context(tempfile.TemporaryFile())
        arguments = command.words(line.name, probe.name, folder)
        started = _started(arguments, folder, command.typed, case[2], told.fileno())
        with started as (process, hang_up):
            run = Run(process, line, probe, hang_up, draw)
            PHASES[case[1]](run)
            moved = probe.seen
            again = hung = False
            WAYS[case[2]](run)
            try:
                process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                again = True
                process.terminate()
            try:
                process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                hung = True
                process.kill()
        line.drained()
        told.seek(0)
        said = told.read().decode(errors="replace")
        # Python loses a SIGINT that comes while it ends an import, and says that it ignored it.
        lost = again and "Exception ignored in" in said and case[1] == "before the first byte"
        return Exit(case, moved, probe.moving, hung or (again and not lost), lost, said)


@contextmanager
def _started(
    words: list[str], folder: Path, typed: str, way: str, errors: int
) -> Iterator[tuple[subprocess.Popen[bytes], Callable[[], None]]]:
    """Start a command on a terminal, or on pipes; gives the process, and what hangs up on it."""
    if way == "hang-up":
        master, slave = os.openpty()
        open_ends = [master]
        streams = [slave] * 3
    else:
        reader, writer = os.pipe()
        stdin, typing = os.pipe()
        os.write(typing, typed.encode())
        open_ends = [reader, typing]
        streams = [stdin, writer, errors]
    process = subprocess.Popen(
        words,
        stdin=streams[0],
        stdout=streams[1],
        stderr=streams[2],
        cwd=folder,
        start_new_session=True,
        preexec_fn=(lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0)) if way == "hang-up" else None,
        env=os.environ | {"TERM": "xterm", "PROMPT_TOOLKIT_NO_CPR": "1"},
    )
    for end in {*streams} - {errors}:
        os.close(end)
    if way == "hang-up" and typed:
        os.write(open_ends[0], typed.replace("\n", "\r").encode())
    reading = threading.Thread(target=_read_all, args=(open_ends[0],), daemon=True)

    def hang_up() -> None:
        while open_ends:
            os.close(open_ends.pop())

    if way != "broken pipe":  # which is not read from before it breaks
        reading.start()
    try:
        yield process, hang_up
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
        hang_up()


def _read_all(descriptor: int) -> None:
    with suppress(OSError):
        while select.select([descriptor], [], [], 0.05) and os.read(descriptor, 1 << 12):
            pass


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    """End so many runs, drawn by the seed, two at a time; a row for each command."""
    draw = Random(seed)
    ends: dict[str, list[Exit]] = {name: [] for name in COMMANDS}
    rows = [draw.choice(CASES) for _ in range(runs)]
    with ThreadPoolExecutor(2) as pool:
        for one in pool.map(ended, rows, range(seed, seed + runs)):
            ends[one.case[0]].append(one)
            progress(1)
    return [_row(name, exits) for name, exits in ends.items() if exits]


def _row(name: str, exits: list[Exit]) -> Row:
    moved, left = sum(one.moved for one in exits), sum(one.left_moving for one in exits)
    lost = sum(one.lost for one in exits)
    return Row(
        f"`{name}` ended in any phase by a signal, a broken pipe or a hang-up",
        len(exits),
        f"{left} robots left moving, of {moved} that moved; "
        f"{sum(one.hung for one in exits)} commands did not end"
        f"{f', {lost} lost the first Ctrl-C as Python began' if lost else ''}",
        tuple(f"{', '.join(one.case)}: {one.told.strip()[-200:]}" for one in exits if not one.held),
    )


HARM = Harm("exits", "commands that drive are ended from outside", 200, _measure)
