"""The suite over a network that holds each byte up for a random time; the order stays.

A relay over TCP stands between the suite and the robot.
"""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from contextlib import ExitStack, suppress
from random import Random

from benchmarks.torture.harm import Harm, Progress, Row
from benchmarks.torture.robots import Hurt, LocalServer, Served, faulty, measure
from bilprov.analyzer.transport.streams import parse_address

LONGEST = (0.010, 0.020, 0.030, 0.040, 0.050)  # s that a byte is held up for at most
FAULTY = faulty("ok-to-unknown-id", "no-stop-on-bad-data", "every-7th-fault-missed")
_LOOK = 0.02  # s after which the relay sees that it is to end


class Delayed:
    """Bytes on their way: each is held up for up to `longest` (s), and none passes another."""

    def __init__(self, longest: float, draw: Random) -> None:
        self._longest, self._draw = longest, draw
        self._held: deque[tuple[float, int]] = deque()

    def put(self, data: bytes, now: float) -> None:
        """Take bytes that came now (s)."""
        for byte in data:
            last = self._held[-1][0] if self._held else now
            self._held.append((max(last, now + self._draw.uniform(0.0, self._longest)), byte))

    def take(self, now: float) -> bytes:
        """The bytes that are held up no longer."""
        due = bytearray()
        while self._held and self._held[0][0] <= now:
            due.append(self._held.popleft()[1])
        return bytes(due)

    @property
    def until(self) -> float | None:
        """When the next byte is due (s), None if there is none."""
        return self._held[0][0] if self._held else None


class Relay(LocalServer):
    """Relays TCP between one host at a time and the robot at `port`, and holds bytes up.

    `up` and `down` are the longest times (s) to the robot and from it. The block ends once the host
    has hung up, and what was still on its way to the robot has arrived.
    """

    def __init__(self, port: str, up: float, down: float, draw: Random) -> None:
        self._robot = parse_address(port.removeprefix("socket://"))
        self._up, self._down, self._draw = up, down, draw
        super().__init__(self._serve)
        self.name = f"socket://{self.address}"

    def _serve(self) -> None:
        while not self._over.is_set():
            if not select.select([self._listener], [], [], _LOOK)[0]:
                continue
            with (
                suppress(OSError),
                self._listener.accept()[0] as host,
                socket.create_connection(self._robot) as robot,
            ):
                self._relay(host, robot)

    def _relay(self, host: socket.socket, robot: socket.socket) -> None:
        """Relay until one side hangs up, and all that came for the robot has arrived."""
        ways = {
            host: (robot, Delayed(self._up, self._draw)),
            robot: (host, Delayed(self._down, self._draw)),
        }
        for end in ways:
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        open_ends, to_robot = list(ways), ways[host][1]
        while to_robot.until is not None or len(open_ends) == len(ways):
            now = time.monotonic()
            dues = [held.until - now for _, held in ways.values() if held.until is not None]
            wait = max(0.0, min([_LOOK, *dues]))
            for end in select.select(open_ends, [], [], wait)[0]:
                data = b""
                with suppress(ConnectionError):
                    data = end.recv(1 << 12)
                if data:
                    ways[end][1].put(data, time.monotonic())
                else:
                    open_ends.remove(end)
            for to, held in ways.values():
                with suppress(OSError):  # who has gone hears nothing more
                    to.sendall(held.take(time.monotonic()))


def _held_up(up: float, down: float) -> Hurt:
    def between(stack: ExitStack, robot: Served, draw: Random) -> tuple[str, str]:
        relay = stack.enter_context(Relay(robot.port, up, down, draw))
        return relay.name, robot.probe.name

    return Hurt(between, served=("--listen", "127.0.0.1:0"))


HURTS = {
    **{
        f"over TCP that holds each byte up for 0 to {longest * 1e3:.0f} ms": _held_up(
            longest, longest
        )
        for longest in LONGEST
    },
    f"over TCP that holds each answer up for 0 to {LONGEST[-1] * 1e3:.0f} ms": _held_up(
        0.0, LONGEST[-1]
    ),
}


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    return measure(HURTS, FAULTY, runs, seed, progress)


HARM = Harm("jitter", "the suite over a network that holds bytes up", 4 * len(HURTS), _measure)
