"""Real lines for tests: ptys to sniff, a robot on a pty, and the command while it runs."""

from __future__ import annotations

import json
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bilprov.analyzer.transport.port import Port, PtyPair
from bilprov.spec.codec import judge
from bilprov.spec.framing import Framer
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.robots import PATIENCE, served_here


def json_lines(output: bytes) -> list[dict[str, Any]]:
    return [json.loads(line) for line in output.splitlines()]


class Running:
    """The command while it runs."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "bilprov", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=ROOT,
            bufsize=0,  # `communicate` does not give what a buffer holds
            process_group=0,  # in the group of tests run in the background nothing is suspended
        )
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        self.stdout, self.stderr = self.process.stdout, self.process.stderr

    def wait_for(self, path: Path) -> None:
        """Wait until the capture exists: from then on the ports are open."""
        give_up = time.monotonic() + PATIENCE
        while not path.exists():
            assert self.process.poll() is None, self.stderr.read().decode()
            assert time.monotonic() < give_up
            time.sleep(0.01)

    def end(self, how: signal.Signals = signal.SIGINT) -> tuple[int, bytes, bytes]:
        """Stop it; gives exit code, standard output and standard error."""
        self.process.send_signal(how)
        return self.result()

    def result(self) -> tuple[int, bytes, bytes]:
        """Wait for its end."""
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out, err


@contextmanager
def running(*arguments: str) -> Iterator[Running]:
    command = Running(*arguments)
    try:
        yield command
    finally:
        if command.process.poll() is None:
            command.process.kill()
        command.process.wait()
        command.stdout.close()
        command.stderr.close()


def master_gives(pty: PtyPair, count: int) -> bytes:
    """So many bytes that were written to a pty."""
    data = b""
    while len(data) < count:
        select.select([pty.master], [], [])
        data += pty.read()
    return data


def read_from(port: Port, count: int) -> bytes:
    """Read `count` bytes; the test's own time limit ends a wait that is in vain."""
    data = b""
    while len(data) < count:
        select.select([port], [], [])
        data += port.read()
    return data


class PtyRobot:
    """A device that judges by the protocol; `wrong` maps frames to other answers."""

    def __init__(self, protocol: Protocol, wrong: dict[bytes, int] | None = None) -> None:
        self.frames: list[bytes] = []
        self._protocol = protocol
        self._wrong = wrong or {}
        self._framer = Framer(protocol, 50_000_000)
        self._answers = bytearray()

    def receive(self, data: bytes, now: int) -> None:
        self._take(self._framer.feed(data, now))

    def advance(self, now: int) -> bytes:
        self._take(self._framer.advance(now))
        answers = bytes(self._answers)
        self._answers.clear()
        return answers

    def deadline(self) -> int | None:
        return self._framer.deadline

    def probe(self, now: int) -> bytes:
        return b"{}"

    def _take(self, records: Any) -> None:
        for record in records:
            self.frames.append(record.data)
            code = judge(self._protocol, record.data).response.code
            self._answers.append(self._wrong.get(record.data, code))


@contextmanager
def served(robot: PtyRobot) -> Iterator[str]:
    """Serve a robot on a pty; gives the pty's name."""
    with served_here(robot, pty=True) as (port, _):
        yield port
