"""Two ptys as the two directions of a line, with traffic on them, and a program that listens."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import signal
import struct
import subprocess
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from benchmarks.commands import Stream, cpu_time, holds_open, started
from benchmarks.traffic import Traffic, reads
from bilprov.analyzer.transport.port import PtyPair, open_pty
from bilprov.spec.protocol import Protocol

_PERIOD = 1_000_000  # ns between two bursts, about; the least that USB adapters wait
_BUFFER = 1 << 16  # bytes that wait for a slow reader; a driver's buffer is ten times as large
_PATIENCE = 30.0  # s to begin, and to end
_STARTS = 0.5  # s from when a listener has opened its lines until traffic begins
_SETTLES = 0.25  # s that are waited for the last bytes

Burst = tuple[bytes, bytes]
"""What the host and the device send in one period."""


class Bursts(NamedTuple):
    """Bursts, and the time (ns) from one to the next."""

    ready: list[Burst]
    period: int


class Heard(NamedTuple):
    """What listening took, in parts of a core, and how many bytes were sent meanwhile."""

    share: float
    sent: int


class Wires(NamedTuple):
    """The two directions of a line."""

    host: PtyPair
    device: PtyPair


@contextmanager
def wires() -> Iterator[Wires]:
    """Two new ptys."""
    with open_pty() as host, open_pty() as device:
        yield Wires(host, device)


def bursts(said: Traffic, protocol: Protocol, byte_time: int) -> Bursts:
    """The traffic in bursts of whole bytes, the answers to a burst's frames with it."""
    size = max(1, round(_PERIOD / byte_time))
    found: list[Burst] = []
    for chunk in reads(said, protocol, size, 1):
        if chunk.direction == "host":
            found.append((chunk.data, b""))
        else:
            found[-1] = found[-1][0], chunk.data
    return Bursts(found, size * byte_time)


class _End:
    """One direction's sender: what the reader has no room for waits in a buffer, or is lost."""

    def __init__(self, line: PtyPair) -> None:
        self._line = line
        self._waiting = bytearray()
        self.sent = 0

    def push(self, data: bytes) -> bool:
        """Send what there is room for; returns whether nothing waits."""
        self.sent += len(data)
        self._waiting += data[: _BUFFER - len(self._waiting)]
        del self._waiting[: self._line.write_some(bytes(self._waiting))]
        return not self._waiting


def send(on: Wires, traffic: Bursts, seconds: float) -> int:
    """Send bursts in their time, over and over, for so many seconds; returns how many bytes."""
    host, device = _End(on.host), _End(on.device)
    ready, period = traffic
    begun, count = time.monotonic_ns(), 0
    while (due := (time.monotonic_ns() - begun) // period) < seconds * 1e9 / period:
        now = [ready[place % len(ready)] for place in range(count, due)]
        host.push(b"".join(said for said, _ in now))
        device.push(b"".join(answered for _, answered in now))
        count = due
        time.sleep(max(0, begun + (count + 1) * period - time.monotonic_ns()) / 1e9)
    until = time.monotonic() + _SETTLES
    while time.monotonic() < until and not (host.push(b"") & device.push(b"")):
        time.sleep(period / 1e9)
    return host.sent + device.sent


def await_listener(process: subprocess.Popen[bytes], on: Wires) -> None:
    """Wait until a program has opened both lines. Raises RuntimeError if it does not."""
    until = time.monotonic() + _PATIENCE
    while not all(holds_open(process.pid, line.name) for line in on):
        if process.poll() is not None or time.monotonic() > until:
            raise RuntimeError("the listener has not opened its lines")
        time.sleep(0.01)
    time.sleep(_STARTS)


def listen(
    words: list[str], on: Wires, traffic: Bursts, seconds: float, out: Stream, screen: Stream
) -> Heard:
    """Run a program that listens while traffic passes, then end it by SIGINT.

    Its time is counted from when it waits for traffic until the last byte was heard.
    """
    with started(words, stdin=screen, stdout=out, stderr=screen) as process:
        await_listener(process, on)
        before = cpu_time(process.pid)
        sent = send(on, traffic, seconds)
        time.sleep(_SETTLES)
        if process.poll() is not None:
            raise RuntimeError(f"the listener has ended with {process.returncode}")
        used = cpu_time(process.pid) - before
        process.send_signal(signal.SIGINT)
        process.wait(_PATIENCE)
    return Heard(used / seconds, sent)


def opened_terminal() -> tuple[int, int]:
    """A terminal of 120 x 40: the descriptors of our end and of its program's."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
    return ours, theirs


@contextmanager
def screen() -> Iterator[int]:
    """A terminal that somebody reads: the descriptor of its program's end."""
    ours, theirs = opened_terminal()

    def read() -> None:
        with suppress(OSError):
            while os.read(ours, 1 << 16):
                pass

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        yield theirs
    finally:
        os.close(theirs)
        reader.join(_PATIENCE)
        os.close(ours)


def shown(path: Path) -> int:
    """How many bytes of both directions the JSON lines of a file hold."""
    with path.open("rb") as file:
        rows = map(json.loads, file)
        return sum(len(row["hex"].split()) for row in rows if row.get("hex"))
