"""Commands that drive a robot are ended from outside: how often one is left moving. Never.

Each run ends one command in one phase in one way, drawn by the seed, while it drives
`bilprov simulate` over a relay, and asks the probe afterwards. SIGKILL is not among the ways:
nothing that a program does can follow it. The harm `signals` does the same with each signal that
ends or suspends a process, while the robot moves.
"""

from __future__ import annotations

import fcntl
import os
import select
import signal
import subprocess
import sys
import tempfile
import termios
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from random import Random
from textwrap import indent
from typing import NamedTuple

from benchmarks.adapter import Adapter
from benchmarks.commands import bilprov_words
from benchmarks.product import metadata
from benchmarks.torture.harm import Harm, Row, tracked
from benchmarks.torture.robots import Probe, served
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import MS, Chunk
from bilprov.captures.writer import CaptureWriter
from bilprov.conformance.cases.case import full_state
from bilprov.spec.by_effect import frames_to, movers
from bilprov.spec.fields import Outcome

_PATIENCE = 90.0  # s until a command that was ended must have ended
_REACHED = 30.0  # s for a phase to come
_QUIET = 0.03  # s without a byte: a pause
_LATE = (300, 2500)  # bytes of a run with a failure, which is tried again and minimised


def _moving_frames() -> tuple[bytes, ...]:
    protocol = load_protocol()
    return frames_to(protocol, full_state(protocol, next(iter(movers(protocol)))))


def items(*, pause: str) -> list[str]:
    """What sets a robot moving and lets it drive, as `send` takes it."""
    return [*(frame.hex() for frame in _moving_frames()), pause] * 4


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


_IN_A_THREAD = """
import threading
from bilprov import Robot
def drive():
{}
thread = threading.Thread(target=drive)
thread.start()
thread.join()
"""


def _driver(script: str) -> Command:
    frames = [frame.hex() for frame in _moving_frames()]
    return Command(lambda port, probe, folder: [sys.executable, "-c", script, port, *frames])


def _seeing(name: str, *more: str, typed: str = "", fault: str = "") -> Command:
    """A command that has a port and a probe."""

    def words(port: str, probe: str, folder: Path) -> list[str]:
        return bilprov_words(*name.split(), port, "--probe", probe, "--yes", *more)

    return Command(words, typed, fault)


def _plugin(port: str, probe: str, folder: Path) -> list[str]:
    options = ["--robot-port", port, "--robot-probe", probe, "--robot-yes"]
    alone = ["-p", "no:cacheprovider", "--rootdir", str(folder), "--robot-level", "smoke"]
    return [sys.executable, "-m", "pytest", "-q", *alone, *options]


def replay_to(port: str, folder: Path) -> list[str]:
    """The command that sends a drive again."""
    return bilprov_words("replay", str(drive_capture(folder)), "--to", port, "--yes")


def drive_capture(folder: Path) -> Path:
    """A recording in which a robot drives with pauses."""
    path = folder / "drive.mcap"
    protocol = load_protocol()
    about = metadata(protocol)
    code = protocol.answers[Outcome.VALID].code
    with CaptureWriter(path, start_wall=time.time_ns(), metadata=about, version="0") as out:
        for turn, (number, frame) in product(range(20), enumerate(_moving_frames())):
            t = turn * 300 * MS + number * 10 * MS
            out.chunk(Chunk(t, "host", frame))
            out.chunk(Chunk(t + MS, "device", bytes([code])))
    return path


COMMANDS = {
    "conform": _seeing("conform", "--level", "smoke"),
    "conform, faulty": _seeing(
        *("conform", "--only", "split/*", "--only", "valid/*"), fault="led-order-reversed"
    ),
    "conform, slow probe": _seeing(
        *("conform", "--probe", "exec:sleep 5", "--only", "wrong-length/*")
    ),
    "send": Command(
        lambda port, probe, folder: bilprov_words("send", port, *items(pause="pause=300"), "--yes")
    ),
    "send, typed": _seeing("send", typed="\n".join(items(pause="pause=300")) + "\n"),
    "replay --to": Command(lambda port, probe, folder: replay_to(port, folder)),
    "lab learn": _seeing("lab learn"),
    "plugin": Command(_plugin),
    "Robot": _driver(_DRIVE.format("pass")),
    "Robot, exception": _driver(_DRIVE.format("assert turn < 2")),
}
_SIGNALLED = "send", "send, typed", "conform", "replay --to", "lab learn", "plugin", "Robot"
SIGNALLED = {
    **{name: COMMANDS[name] for name in _SIGNALLED},
    "Robot, another thread": _driver(_IN_A_THREAD.format(indent(_DRIVE.format("pass"), "  "))),
}
"""The commands that are sent every signal."""


class Run(NamedTuple):
    """A command that runs: its process, line and probe, and the terminal or pipes that it has."""

    process: subprocess.Popen[bytes]
    line: Adapter
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
    _wait(run, lambda: run.line.passed >= bytes_sent)


PHASES: dict[str, Callable[[Run], None]] = {
    # Python itself may lose a SIGINT until it has begun with the command.
    "before the first byte": lambda run: time.sleep(run.draw.uniform(0.1, 0.5)),
    "homing": lambda run: _wait(run, lambda: run.line.passed > 0),
    "while moving": _moves,
    "in a pause": lambda run: _wait(run, lambda: run.line.quiet > _QUIET and run.probe.moving),
    "waiting for an answer": _waits,
    "late in the run": _is_late,
    "while reporting": _reports,
}


DRIVING = ("while moving", "in a pause", "waiting for an answer")
"""The phases in which the robot moves."""


def _signals(*numbers: int) -> Callable[[Run], None]:
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


WAYS: dict[str, Callable[[Run], None]] = {
    "SIGINT": _signals(signal.SIGINT),
    "SIGTERM": _signals(signal.SIGTERM),
    "SIGHUP": _signals(signal.SIGHUP),
    "SIGINT twice": _signals(signal.SIGINT, signal.SIGINT),
    "SIGINT four times": _signals(*[signal.SIGINT] * 4),
    "SIGTERM after SIGINT": _signals(signal.SIGINT, signal.SIGTERM),
    "broken pipe": _broken_pipe,
    "hang-up": lambda run: run.hang_up(),
    "SIGTERM, slow reader": _slow,
}


def _suspended(run: Run) -> None:
    """Suspend a command, see that its robot is at rest, and end it; where it moves, at once."""
    run.process.send_signal(signal.SIGTSTP)
    _wait(run, lambda: is_suspended(run.process.pid))
    run.line.drained()
    if is_suspended(run.process.pid) and run.probe.moving:
        run.process.kill()
    run.process.send_signal(signal.SIGCONT)
    run.process.terminate()


def is_suspended(pid: int) -> bool:
    """Whether a process has been stopped by a signal, and may be continued."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
    return False


_NAMED = (
    *("INT", "TERM", "HUP", "QUIT", "USR1", "USR2", "ALRM"),
    *("XCPU", "VTALRM", "PROF", "IO", "PWR", "STKFLT"),
)
_REAL_TIME = {
    **{f"SIGRTMIN+{more}": signal.SIGRTMIN + more for more in (0, 1, 15)},
    **{f"SIGRTMAX-{less}": signal.SIGRTMAX - less for less in (0, 1)},
}
_SUSPEND = "SIGTSTP"
SIGNALS: dict[str, Callable[[Run], None]] = {
    **{f"SIG{name}": _signals(signal.Signals[f"SIG{name}"]) for name in _NAMED},
    **{name: _signals(number) for name, number in _REAL_TIME.items()},
    _SUSPEND: _suspended,
}
"""What ends or suspends a process that does not handle it, and may be handled."""

Case = tuple[str, str, str]

CASES: tuple[Case, ...] = tuple(product(COMMANDS, PHASES, WAYS))
"""Each command, phase and way."""

SIGNAL_CASES: tuple[Case, ...] = tuple(product(SIGNALLED, DRIVING, SIGNALS))
"""Each command that is sent signals in each phase in which its robot moves, with each signal."""


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


def ended(case: Case, seed: int) -> Exit:
    """Run a command, end it in that phase in that way, and see what the robot does then."""
    command, draw = (COMMANDS | SIGNALLED)[case[0]], Random(f"{seed} {case}")
    fault = ["--fault", command.fault] if command.fault else []
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        port, probe = stack.enter_context(served(*fault))
        line = stack.enter_context(Adapter(folder / "port", port))
        told = stack.enter_context(tempfile.TemporaryFile())
        arguments = command.words(str(folder / "port"), probe.name, folder)
        started = _started(arguments, folder, command.typed, case[2], told.fileno())
        with started as (process, hang_up):
            run = Run(process, line, probe, hang_up, draw)
            PHASES[case[1]](run)
            moved = probe.seen
            (WAYS | SIGNALS)[case[2]](run)
            again = _hangs(process, process.terminate)
            hung = _hangs(process, process.kill)
        line.drained()
        told.seek(0)
        said = told.read().decode(errors="replace")
        # Python loses a SIGINT that comes while it ends an import, and says that it ignored it.
        lost = again and "Exception ignored in" in said and case[1] == "before the first byte"
        return Exit(case, moved, probe.moving, hung or (again and not lost), lost, said)


def _hangs(process: subprocess.Popen[bytes], end: Callable[[], object]) -> bool:
    """Whether a process does not end by itself in time; then it is ended."""
    try:
        process.wait(_PATIENCE)
    except subprocess.TimeoutExpired:
        end()
        return True
    return False


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
        # In a session of its own, of which nobody else is, a process cannot be suspended.
        start_new_session=way != _SUSPEND,
        process_group=0 if way == _SUSPEND else None,
        preexec_fn=(lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0)) if way == "hang-up" else None,
        env=os.environ | {"TERM": "xterm", "PROMPT_TOOLKIT_NO_CPR": "1"},
    )
    for end in {*streams} - {errors}:
        os.close(end)
    if way == "hang-up" and typed:
        os.write(open_ends[0], typed.replace("\n", "\r").encode())
    over = threading.Event()
    reading = threading.Thread(target=_read_all, args=(open_ends[0], over), daemon=True)

    def hang_up() -> None:
        over.set()
        if reading.is_alive():  # it would read what gets the number of a closed descriptor next
            reading.join()
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


def _read_all(descriptor: int, over: threading.Event) -> None:
    with suppress(OSError):
        while not over.is_set():
            if select.select([descriptor], [], [], 0.05)[0] and not os.read(descriptor, 1 << 12):
                return


def _measure(runs: int, seed: int) -> list[Row]:
    """End so many runs, drawn by the seed; a row for each command."""
    draw = Random(seed)
    how = "ended in any phase by a signal, a broken pipe or a hang-up"
    return _rows([draw.choice(CASES) for _ in range(runs)], seed, how)


def _measure_signals(runs: int, seed: int) -> list[Row]:
    """Send signals in so many runs, all before one comes again; a row for each command."""
    draw, cases = Random(seed), list[Case]()
    while len(cases) < runs:
        cases += draw.sample(SIGNAL_CASES, len(SIGNAL_CASES))
    return _rows(cases[:runs], seed, "sent any signal while its robot moves")


def _rows(cases: list[Case], seed: int, how: str) -> list[Row]:
    """Run the cases two at a time."""
    ends = defaultdict[str, list[Exit]](list)
    with ThreadPoolExecutor(2) as pool:
        for one in tracked(pool.map(ended, cases, range(seed, seed + len(cases))), len(cases)):
            ends[one.case[0]].append(one)
    return [_row(name, how, ends[name]) for name in COMMANDS | SIGNALLED if name in ends]


def _row(name: str, how: str, exits: list[Exit]) -> Row:
    moved, left = sum(one.moved for one in exits), sum(one.left_moving for one in exits)
    lost = sum(one.lost for one in exits)
    wrong = [one for one in exits if one.left_moving or one.hung]
    return Row(
        f"`{name}` {how}",
        len(exits),
        f"{left} robots left moving, of {moved} that moved; "
        f"{sum(one.hung for one in exits)} commands did not end"
        f"{f', {lost} lost the first Ctrl-C as Python began' if lost else ''}",
        tuple(f"{', '.join(one.case)}: {one.told.strip()[-200:]}" for one in wrong),
    )


HARMS = (
    Harm("exits", "commands that drive are ended from outside", 200, _measure),
    Harm(
        "signals",
        "each signal is sent to commands that drive",
        len(SIGNAL_CASES) // len(DRIVING),
        _measure_signals,
    ),
)
