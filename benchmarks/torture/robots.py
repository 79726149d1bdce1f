"""A simulated robot in a process of its own, and its probe."""

from __future__ import annotations

import json
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import NamedTuple

from benchmarks.commands import bilprov_words, started
from bilprov.analyzer.transport.server import parse_address


class Probe:
    """The simulator's probe at an address."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.seen = False
        """Whether the robot moved when it was last observed."""
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


class Served(NamedTuple):
    """The name of a served robot's port, and its probe."""

    port: str
    probe: Probe


@contextmanager
def served(*more: str) -> Iterator[Served]:
    """Serve the simulator on a pty, with these words more."""
    words = bilprov_words("simulate", "--probe-listen", "127.0.0.1:0", *more)
    with ExitStack() as stack:
        process = stack.enter_context(started(words, stdout=subprocess.PIPE))
        stack.callback(process.terminate)
        assert process.stdout is not None
        port, probe = (process.stdout.readline().decode().strip() for _ in range(2))
        yield Served(port, stack.enter_context(closing(Probe(probe.removeprefix("probe ")))))
