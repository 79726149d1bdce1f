"""Runs commands and takes their time, CPU time and memory."""

from __future__ import annotations

import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Timer
from typing import IO, TypeAlias

ROOT = Path(__file__).resolve().parent.parent
Stream: TypeAlias = "int | IO[bytes]"
_PATIENCE = 300.0  # s
_TICK = os.sysconf("SC_CLK_TCK")


def tell(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


@dataclass(frozen=True, slots=True)
class Ended:
    """How a command ended: time and CPU time in s, peak memory in bytes, and its output if kept.

    `error` is what it said on standard error, `code` its exit code.
    """

    seconds: float
    cpu: float
    memory: int
    output: str = ""
    error: str = ""
    code: int = 0


def bilprov_words(*words: str) -> list[str]:
    """A command of bilprov in this Python."""
    return [sys.executable, "-m", "bilprov", *words]


@contextmanager
def started(
    words: list[str],
    stdin: Stream = subprocess.DEVNULL,
    stdout: Stream = subprocess.DEVNULL,
    stderr: Stream = subprocess.DEVNULL,
    kept: Sequence[int] = (),
) -> Iterator[subprocess.Popen[bytes]]:
    """A program that runs in a session of its own; what has not ended at the end is killed.

    It inherits the descriptors `kept`.
    """
    # Without its cache of compiled files each start of Python would take far longer.
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT / "src"), str(ROOT)])
    with subprocess.Popen(
        words,
        stdin=stdin,
        stdout=stdout,
        stderr=stderr,
        pass_fds=kept,
        env=environment,
        start_new_session=True,
    ) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


# A process begins with the peak memory of the one that has started it: a small one must start it.
_LAUNCH = """
import json, os, sys, time
begun = time.perf_counter()
pid = os.posix_spawnp(sys.argv[2], sys.argv[2:], os.environ)
_, status, used = os.wait4(pid, 0)
took = time.perf_counter() - begun
figures = [took, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024]
os.write(int(sys.argv[1]), json.dumps([os.waitstatus_to_exitcode(status), *figures]).encode())
"""


def run(words: list[str], *, keep: bool = False, patience: float = _PATIENCE) -> Ended:
    """Run a program to its end, its output kept or dropped.

    Raises TimeoutError if it takes longer than `patience` (s), RuntimeError if it fails.
    """
    ended = run_any(words, keep=keep, patience=patience)
    if ended.code:
        last = ended.error.strip().splitlines()[-1:]
        raise RuntimeError(f"{' '.join(words)}: exit {ended.code}: {''.join(last)}")
    return ended


def run_any(
    words: list[str],
    *,
    keep: bool = False,
    patience: float = _PATIENCE,
    stdin: Stream = subprocess.DEVNULL,
) -> Ended:
    """Run a program to its end, whatever its exit code. Raises TimeoutError as `run` does."""
    with (
        tempfile.TemporaryFile() as output,
        tempfile.TemporaryFile() as error,
        tempfile.TemporaryFile() as figures,
    ):
        told = figures.fileno()
        start = [sys.executable, "-S", "-c", _LAUNCH, str(told), *words]
        out = output if keep else subprocess.DEVNULL
        with started(start, stdin, out, error, kept=[told]) as process:
            try:
                process.wait(patience)
            except subprocess.TimeoutExpired:
                raise TimeoutError(f"it took longer than {patience:.0f} s") from None
        for file in (output, error, figures):
            file.seek(0)
        code, took, cpu, memory = json.load(figures)
        said, told_why = (file.read().decode(errors="replace") for file in (output, error))
        return Ended(took, cpu, memory, said, told_why, code)


def first_line(words: list[str], patience: float = _PATIENCE) -> float:
    """How long (s) a program takes to its first line. Raises TimeoutError as `run` does."""
    begun = time.perf_counter()
    with started(words, stdout=subprocess.PIPE) as process:
        timer = Timer(patience, process.kill)
        timer.start()
        line = process.stdout.readline() if process.stdout else b""
        took = time.perf_counter() - begun
        timer.cancel()
    if took >= patience:
        raise TimeoutError(f"it took longer than {patience:.0f} s")
    if not line:
        raise RuntimeError(f"{' '.join(words)} printed nothing")
    return took


def cpu_time(pid: int) -> float:
    """The CPU time (s) that a running process has used, all of its threads and children."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / _TICK


def holds_open(pid: int, path: str) -> bool:
    """Whether a process has a file open."""
    try:
        return any(str(link.readlink()) == path for link in Path(f"/proc/{pid}/fd").iterdir())
    except OSError:
        return False


def medians(rounds: int, works: Mapping[str, Callable[[], float]]) -> dict[str, float]:
    """The median of each work's figures; the rounds are interleaved, so that noise meets all."""
    figures: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            figures[name].append(work())
    return {name: statistics.median(found) for name, found in figures.items()}


def timed(work: Callable[[], object]) -> float:
    """How long (s) a call takes."""
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun
