"""Simulated robots in processes of their own, and what the suite says of them under a harm.

A harm stands between the suite and the robot, or hurts their processes while the suite runs. A
good robot may not fail, a faulty one may not pass, and none may be left moving.
"""

from __future__ import annotations

import json
import socket
import subprocess
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from random import Random
from types import TracebackType
from typing import Any, NamedTuple, Self

from benchmarks.commands import bilprov_words, started
from benchmarks.torture.harm import Progress, Row
from bilprov.analyzer.transport.streams import parse_address

_PATIENCE = 600.0  # s: a run over a line that is very slow ends itself in less than 300
_ARRIVED = 0.1  # s for what has been sent to arrive


class Probe:
    """What the simulator's probe tells."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.seen = False
        """Whether it moved when it was looked at last."""
        self._socket = socket.create_connection(parse_address(name.removeprefix("tcp:")), 30)
        self._answers = self._socket.makefile("rb")

    def look(self) -> dict[str, Any]:
        """All that it sees now."""
        self._socket.sendall(b"state\n")
        look: dict[str, Any] = json.loads(self._answers.readline())
        look.pop("number", None)  # a probe that hands looks on numbers its own replies, or none
        return look

    @property
    def moving(self) -> bool:
        """Whether the robot moves now."""
        self.seen = bool(self.look()["moving"])
        return self.seen

    def close(self) -> None:
        """Hang up."""
        self._answers.close()
        self._socket.close()


class LocalServer:
    """Listens at a free port of this machine and serves it in a thread until the block ends."""

    def __init__(self, serve: Callable[[], None]) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self._over = threading.Event()
        self._thread = threading.Thread(target=serve)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()
        self._listener.close()


class Served(NamedTuple):
    """A robot that is served: its process, the name of its port, and its probe."""

    process: subprocess.Popen[bytes]
    port: str
    probe: Probe


@contextmanager
def served(*more: str) -> Iterator[Served]:
    """Serve the simulator with these words more, on a pty unless they say otherwise."""
    words = bilprov_words("simulate", "--probe-listen", "127.0.0.1:0", *more)
    with ExitStack() as stack:
        process = stack.enter_context(started(words, stdout=subprocess.PIPE))
        stack.callback(process.terminate)
        assert process.stdout is not None
        port, told = (process.stdout.readline().decode().strip() for _ in range(2))
        probe = Probe(told.removeprefix("probe "))
        stack.callback(probe.close)
        yield Served(process, port, probe)


class Robot(NamedTuple):
    """A robot to be judged: whether it is good, and the fault or the legal variant that it has."""

    good: bool
    name: str = ""

    def __str__(self) -> str:
        return self.name or "the reference"

    @property
    def words(self) -> list[str]:
        """How it is served."""
        return ["--variant" if self.good else "--fault", self.name] if self.name else []


GOOD = (Robot(good=True), Robot(good=True, name="R-stop-latency=50-ms"))


def faulty(*names: str) -> tuple[Robot, ...]:
    """Robots with these faults."""
    return tuple(Robot(good=False, name=name) for name in names)


Between = Callable[[ExitStack, Served, Random], tuple[str, str]]
"""What is put between, in a stack that ends it: the port and the probe that the suite is given."""

Beside = Callable[[ExitStack, Served, subprocess.Popen[bytes]], object]
"""What hurts the robot's process or the suite's from then on, in a stack that ends it."""


def _nothing_between(stack: ExitStack, robot: Served, draw: Random) -> tuple[str, str]:
    return robot.port, robot.probe.name


class Hurt(NamedTuple):
    """A way to hurt a run of the suite."""

    between: Between = _nothing_between
    beside: Beside = lambda stack, robot, suite: None
    served: tuple[str, ...] = ()
    """Words more for the robot."""


@dataclass(frozen=True, slots=True)
class Judged:
    """How the suite ended with a robot: the code is None where it did not end."""

    robot: Robot
    code: int | None
    told: str = ""
    left_moving: bool = False

    @property
    def wrong(self) -> str:
        """What went otherwise than it may, "" if nothing did."""
        failed = [line for line in self.told.splitlines() if line.startswith("fail ")]
        last = "; ".join(failed[:3]) or self.told.strip()[-300:]
        if self.code is None:
            return f"{self.robot}: it did not end in {_PATIENCE:g} s: {last}"
        if "Traceback" in self.told:
            return f"{self.robot}: a traceback: {last}"
        if self.left_moving:
            return f"{self.robot}: left moving, exit {self.code}: {last}"
        allowed = (0, 2, 3) if self.robot.good else (1, 2, 3)
        return "" if self.code in allowed else f"{self.robot}: exit {self.code}: {last}"


def judged(robot: Robot, hurt: Hurt, seed: int) -> Judged:
    """Let the suite judge a robot at level smoke while it is hurt."""
    with served(*robot.words, *hurt.served) as there, tempfile.TemporaryFile() as output:
        with ExitStack() as stack:
            port, probe = hurt.between(stack, there, Random(seed))
            # A faulty device has failed with its first failure.
            more = () if robot.good else ("--fail-fast",)
            words = ("conform", port, "--probe", probe, "--yes", "--level", "smoke", "-v", *more)
            suite = stack.enter_context(
                started(bilprov_words(*words), stdout=output, stderr=output)
            )
            hurt.beside(stack, there, suite)
            try:
                code: int | None = suite.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                code = None
        time.sleep(_ARRIVED)
        output.seek(0)
        return Judged(robot, code, output.read().decode(errors="replace"), there.probe.moving)


def measure(
    hurts: dict[str, Hurt],
    faults: Sequence[Robot],
    runs: int,
    seed: int,
    progress: Progress = lambda done: None,
) -> list[Row]:
    """Hurt so many runs, each in the next of the ways; a row for each way.

    A run is a good robot and a faulty one side by side; they take turns.
    """
    names = list(hurts)
    came = defaultdict[str, list[Judged]](list)
    with ThreadPoolExecutor(2) as pool:
        for run in range(runs):
            turn, place = divmod(run, len(names))
            robots = (GOOD[turn % len(GOOD)], faults[(turn + place) % len(faults)])
            hurt = [hurts[names[place]]] * len(robots)
            came[names[place]] += pool.map(judged, robots, hurt, [seed + run] * len(robots))
            progress(1)
    return [_row(what, those) for what, those in came.items()]


def _row(what: str, came: list[Judged]) -> Row:
    left = sum(one.left_moving for one in came)
    told = verdicts((one.robot.good, one.code) for one in came)
    wrong = tuple(one.wrong for one in came if one.wrong)
    if all(one.code == 2 for one in came):
        wrong += (f"no robot was judged: {came[0].told.strip()[-300:]}",)
    return Row(f"the suite {what}", len(came), f"{told}; {left} left moving", wrong)


def verdicts(ended: Iterable[tuple[bool, int | None]]) -> str:
    """In words how runs of good (True) and of faulty robots ended, by their exit codes."""
    codes = {True: Counter[int | None](), False: Counter[int | None]()}
    for good, code in ended:
        codes[good][code] += 1
    told = "; ".join(
        f"{'good' if good else 'faulty'}: "
        + ", ".join(f"exit {code} in {times}" for code, times in sorted(found.items(), key=str))
        for good, found in codes.items()
    )
    return f"{codes[True][1]} good robots failed, {codes[False][0]} faulty ones passed ({told})"
