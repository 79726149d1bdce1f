"""Devices and links for tests of the suite: runs in virtual time, and served simulators."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from bilprov.analyzer.client.operations import (
    LinkListener,
    Observation,
    Observe,
    Operation,
    Received,
    Reply,
    drive,
)
from bilprov.analyzer.transport.server import parse_address, serve
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import Look
from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.cases.single_frames import all_cases
from bilprov.conformance.dut.simulator import Event, Fault, Reaction, Simulator
from bilprov.conformance.dut.target import Environment, Observability, Target, VirtualLink
from bilprov.conformance.mutation.catalogue import find_fault
from bilprov.conformance.oracle.profile import Profile, Timers
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.runner.executor import Runner
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.conformance.runner.run import Run, RunConfig
from bilprov.spec.protocol import Protocol
from tests.support.commands import running

MS = 1_000_000
BYTE_TIME = 86_806  # ns at 115,200 8N1
PATIENCE = 60.0  # s; a test that waits longer hangs

READING_CASES = 19
"""How many cases named reading/* probe what the document leaves open."""

# The probes that pause for a part of the device's time-out.
TIMED_PROBES = ("reading/answer-point", "reading/truncation-timeout")

ALL_SEEING = Observability(available=True)
FEW_LOOKS = Observability(available=True, costly=True)


def simulated(protocol: Protocol, name: str = "") -> Simulator:
    """The reference, or the device of a named fault, variant or mixture."""
    return Simulator(protocol, find_fault(protocol, name) if name else None)


class Blind:
    """A device object whose robot nobody sees."""

    def __init__(self, device: Any) -> None:
        self.receive, self.advance, self.deadline = device.receive, device.advance, device.deadline
        self.lossless = getattr(device, "lossless", False)


class Hidden:
    """A device object that says nothing of its line, or what a test says."""

    def __init__(self, device: Simulator) -> None:
        self.receive, self.advance = device.receive, device.advance
        self.deadline, self.look = device.deadline, device.look


class RecordingRobot(Simulator):
    """A robot that keeps the frames it heard; `wrong` has other answers to some, None for none."""

    def __init__(self, protocol: Protocol, wrong: Mapping[bytes, int | None] | None = None) -> None:
        self.heard: list[bytes] = []
        self._wrong = wrong or {}
        super().__init__(protocol, Fault("x", "test", "", react=self._react))

    def _react(self, device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        frame = event.judgement.frame
        self.heard.append(frame)
        if frame not in self._wrong:
            return reaction
        code = self._wrong[frame]
        return replace(reaction, answers=() if code is None else ((0, code),))


class CountingLink:
    """Virtual time; counts what it is asked. `broken` is asked before each ask and may raise."""

    def __init__(
        self,
        device: Any,
        broken: Callable[[int], None] = lambda asks: None,
        tap: LinkListener | None = None,
    ) -> None:
        self.asks = 0
        self.operations: list[Operation] = []
        self.looks: list[Look] = []
        self._link = VirtualLink(device, BYTE_TIME, tap)
        self._broken = broken

    def do(self, ask: Operation) -> int | Received | Observation:
        self._broken(self.asks)
        self.asks += 1
        self.operations.append(ask)
        reply = self._link.do(ask)
        if isinstance(ask, Observe):
            assert isinstance(reply, Observation)
            self.looks.append(reply.look)
        return reply


class SlowProbe(VirtualLink):
    """A link in virtual time, each look over which takes `look` ns."""

    def __init__(
        self, device: Any, byte_time: int, tap: LinkListener | None = None, look: int = 0
    ) -> None:
        super().__init__(device, byte_time, tap)
        self._look = look

    def do(self, operation: Operation) -> Reply:
        asked = self.now
        if isinstance(operation, Observe):
            self._pass(asked + self._look)
        reply = super().do(operation)
        return reply._replace(asked=asked) if isinstance(reply, Observation) else reply


class OnLine:
    """A robot at a line, judged in virtual time with the timers of a real line.

    `make` makes the link, and `about` is what is known of the line besides its kind.
    """

    def __init__(
        self,
        protocol: Protocol,
        make: Callable[[LinkListener | None], VirtualLink],
        *,
        costly: bool = False,
        announced: float | None = None,
        **about: int,
    ) -> None:
        def connect(listener: LinkListener | None) -> VirtualLink:
            self.link = make(listener)
            return self.link

        known = {"kind": "port", "byte_ns": BYTE_TIME, **about}
        sees = Observability(available=True, costly=costly)
        line = Environment(False, sees, False, "a line", known, announced=announced)
        self.target = Target(protocol, line, connect)


class Notes(RunListener):
    """Keeps the sentences of a run for the user."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def note(self, sentence: str) -> None:
        self.told.append(sentence)


def cases_of(
    protocol: Protocol, *only: str, seed: int = 1, every_cut: bool = False
) -> tuple[Case, ...]:
    """The single-frame cases, or those of them that the globs name."""
    cases = all_cases(protocol, seed, every_cut=every_cut)
    return tuple(case for case in cases if not only or matching(case.id, only))


def case_of(protocol: Protocol, ident: str, seed: int = 1) -> Case:
    (case,) = cases_of(protocol, ident, seed=seed, every_cut=True)
    return case


def new_run(
    protocol: Protocol,
    *,
    timers: Timers | None = None,
    observability: Observability = ALL_SEEING,
    profile: Profile | None = None,
    begin: Callable[[str], None] = lambda ident: None,
    note: Callable[[str], None] = lambda sentence: None,
    **circumstances: Any,
) -> Run:
    """A run that has not begun, of a robot that is seen."""
    config = RunConfig(protocol, timers or Timers(), observability, **circumstances)
    return Run(config, profile, begin=begin, note=note)


def run_over(
    link: CountingLink,
    protocol: Protocol,
    cases: Sequence[AnyCase],
    *,
    observability: Observability = ALL_SEEING,
    timers: Timers | None = None,
    fail_fast: bool = False,
    discover: bool = False,
    interrupted: Callable[[], bool] = lambda: False,
) -> Runner:
    """Run cases over a link to the end; the results are in `runner.run`.

    Without `discover` the device is taken to read the document as the kit does.
    """
    run = new_run(protocol, timers=timers, observability=observability)
    runner = Runner(run, cases, fail_fast=fail_fast, discover=discover)
    drive(runner.execute(), link, interrupted)
    return runner


def failing(results: Sequence[CaseResult]) -> set[str]:
    return {result.id for result in results if result.verdict is Verdict.FAIL}


def matching(ident: str, globs: Sequence[str]) -> bool:
    return any(fnmatchcase(ident, glob) for glob in globs)


def judged_exit(code: int, report: dict[str, Any]) -> int:
    """The exit code of a run in real time that ended with `code` and wrote this JSON report.

    Where nothing else is inconclusive than what a busy machine cannot time, it is 0: pauses in a
    frame, answers that it took up too late, what was not seen again, and what its delays hide.
    """
    assert code == report["exit"]
    unsure = [case for case in report["cases"] if case["verdict"] == "inconclusive"]
    late = all(
        case["id"] in (*TIMED_PROBES, "timing/truncation-timeout", "line/lost", "line/unsolicited")
        or any(
            axis["reason"].startswith(("flaky", "the line delays bytes"))
            for axis in case["axes"].values()
        )
        for case in unsure
    )
    return 0 if code == 3 and late else code


def unwell(result: subprocess.CompletedProcess[bytes]) -> dict[str, str]:
    """The cases that did not pass in a report on standard output, and their verdicts.

    In real time, on a machine that is busy, a pause does not measure the same twice, and is too
    short or too long for some probes: the one case may be inconclusive, those informational or,
    where a stretched pause looks like another choice of the time-out, non-strict. An answer or a
    stop may be seen late there, which is non-strict too.
    """
    report = json.loads(result.stdout)
    found = {c["id"]: c["verdict"] for c in report["cases"] if c["verdict"] != "pass"}
    exit_code = judged_exit(result.returncode, report)
    for case in report["cases"]:
        ident, verdict, axes = case["id"], case["verdict"], case["axes"].values()
        slow = {"R-answer-deadline", "R-stop-latency"} & {axis["reading"] for axis in axes}
        long = any(axis["reason"].endswith("on this link") for axis in axes)
        timed = ident in TIMED_PROBES and verdict in ("informational", "non-strict")
        coarse = verdict == "inconclusive" and exit_code == 0
        late = (verdict == "non-strict" and slow) or (verdict == "informational" and long)
        if timed or coarse or late:
            del found[ident]
    assert exit_code == 0 or {"fail", "error", "inconclusive"} & set(found.values()), result.stderr
    return found


def sentence(result: subprocess.CompletedProcess[bytes]) -> str:
    """The last line on standard error, where what went wrong stands; no traceback before it."""
    told = result.stderr.decode()
    assert "Traceback" not in told, told
    return told.splitlines()[-1]


class Served:
    """A robot that is served by the command: its line, which was announced first, and its probe."""

    def __init__(self, process: subprocess.Popen[bytes], lines: list[str]) -> None:
        self.process = process
        self.lines = lines
        self.port = lines[0]
        self.probe = lines[-1].removeprefix("probe ")

    def state(self) -> dict[str, Any]:
        """What its probe tells now."""
        assert self.process.poll() is None, "the robot ended"
        address = parse_address(self.probe.removeprefix("tcp:"))
        with socket.create_connection(address, PATIENCE) as probe, probe.makefile("rb") as said:
            probe.sendall(b"state\n")
            state = json.loads(said.readline())
        assert isinstance(state, dict)
        assert state.pop("number") == 0  # the reply's own, of a question without one
        return state


def simulate(
    *arguments: str, pty: bool = False, grammar: str = "", like: Served | None = None
) -> AbstractContextManager[Served]:
    """Serve the simulator in a process of its own, on TCP or a pty, with its probe on TCP.

    It has the addresses of the served robot `like` that has ended, if one is given.
    """
    address = like.port.removeprefix("socket://") if like else "127.0.0.1:0"
    line = [] if pty else ["--listen", address]
    before = ["--grammar", grammar] if grammar else []
    probe = like.probe.removeprefix("tcp:") if like else "127.0.0.1:0"
    return _serving(*before, "simulate", *line, *arguments, probe=probe)


def emulate(
    firmware: Path, *arguments: str, lines: int = 2, grammar: str = ""
) -> AbstractContextManager[Served]:
    """Serve an emulated board so; `lines` are what it announces.

    With another `grammar` than the car's it has no probe, and announces one line.
    """
    words = ("simulate", "--firmware", str(firmware), *arguments)
    if grammar:
        return _serving("--grammar", grammar, *words, lines=1, probe="")
    return _serving(*words, lines=lines)


@contextmanager
def _serving(*words: str, lines: int = 2, probe: str = "127.0.0.1:0") -> Iterator[Served]:
    with running(*words, *(("--probe-listen", probe) if probe else ())) as command:
        announced = [command.stdout.readline().decode().strip() for _ in range(lines)]
        assert all(announced), command.stderr.read()
        yield Served(command.process, announced)
        if command.process.poll() is None:
            command.end(signal.SIGTERM)


def until(condition: Callable[[], object]) -> None:
    """Wait until a condition holds."""
    give_up = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < give_up
        time.sleep(0.005)


def at_rest(device: Simulator) -> bool:
    return not device.state.moving


@contextmanager
def serving(
    device: Any, *, pty: bool = False, listen: str | None = None, probe: str | None = None
) -> Iterator[list[str]]:
    """Serve a device of this process; gives the lines that are announced."""
    lines: list[str] = []
    ready = threading.Semaphore(0)

    def announce(line: str) -> None:
        lines.append(line)
        ready.release()

    with Stopper() as stopper:
        given = {"pty": pty, "listen": listen, "probe_listen": probe}
        thread = threading.Thread(
            target=serve, args=(device,), kwargs=given | {"announce": announce, "stop": stopper}
        )
        thread.start()
        try:
            for _ in filter(None, given.values()):
                assert ready.acquire(timeout=PATIENCE)
            yield lines
        finally:
            stopper.stop()
            thread.join(PATIENCE)


@contextmanager
def served_here(device: Any, *, pty: bool = False) -> Iterator[tuple[str, str]]:
    """Serve a device of this process, with its probe; gives the port's and the probe's names."""
    listen = None if pty else "127.0.0.1:0"
    with serving(device, pty=pty, listen=listen, probe="127.0.0.1:0") as (port, probe):
        yield port, probe.removeprefix("probe ")


@contextmanager
def plugged(link: Path, device: Simulator) -> Iterator[None]:
    """Serve the device under a path of its own."""
    with served_here(device, pty=True) as (port, _):
        link.unlink(missing_ok=True)
        link.symlink_to(port)
        yield


class ProbeServer:
    """The other side of `--probe tcp:`; `answers` are given one a request, the last for ever.

    None is no answer, b"" hangs up. `requests` are the lines that came; each is answered after
    `delay` s.
    """

    def __init__(self, *answers: bytes | None, delay: float = 0.0) -> None:
        self.requests: list[bytes] = []
        self._delay = delay
        self._answers = list(answers)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.name = f"tcp:127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        with suppress(OSError):  # nobody came, or whoever came has gone
            peer, _ = self._listener.accept()
            with peer, peer.makefile("rb") as lines:
                for line in lines:
                    self.requests.append(line)
                    answer = self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]
                    time.sleep(self._delay)
                    if answer == b"":
                        return
                    if answer is not None:
                        peer.sendall(answer)

    def __enter__(self) -> ProbeServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(PATIENCE)
