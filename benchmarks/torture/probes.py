"""The suite with probes that lie: they forget, lag, stutter or see what is not there.

A probe of our own stands before the robot's, and hands its looks on in one of the wrong ways.
"""

from __future__ import annotations

import json
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from random import Random
from typing import Any, NamedTuple

from benchmarks.torture.harm import Harm, Progress, Row
from benchmarks.torture.robots import Hurt, LocalServer, Probe, Served, faulty, measure

FAULTY = faulty(
    "no-stop-after-100-faults",
    "every-100th-fault-missed",
    "no-stop-after-200-faults",
    "no-stop-on-bad-data",
    "every-7th-fault-missed",
)
_MID_RUN = (60, 700)  # looks, of some 1,000 of a whole run
_TWICE = 0.1  # of replies
_STEP = 0.002  # s between the looks of a probe that lags
_POLL = 0.02  # s after which a probe sees that it is to end

Look = dict[str, Any]
Tell = Callable[[Sequence[Look]], bytes]
"""What is told of the true looks so far, the newest of them last."""


def line(look: Look) -> bytes:
    """A reply of a probe."""
    return json.dumps(look).encode() + b"\n"


class Lie(NamedTuple):
    """A way to lie, drawn anew for each run; `lag` is how old (s) the looks are that it is of."""

    drawn: Callable[[Random], Tell] = lambda draw: lambda looks: line(looks[-1])
    lag: float = 0.0


def _forgets(draw: Random) -> Tell:
    last = draw.randint(*_MID_RUN)
    return lambda looks: line(looks[-1] if len(looks) <= last else {"moving": None})


def _stutters(draw: Random) -> Tell:
    return lambda looks: line(looks[-1]) * (2 if draw.random() < _TWICE else 1)


def _flips(share: float) -> Callable[[Random], Tell]:
    def drawn(draw: Random) -> Tell:
        def tell(looks: Sequence[Look]) -> bytes:
            true = looks[-1]
            return line(true | {"moving": true["moving"] ^ (draw.random() < share)})

        return tell

    return drawn


def _mixes(draw: Random) -> Tell:
    return lambda looks: line(draw.choice(looks[-3:]))


LIES = {
    "that does not know from a look in mid-run on": Lie(_forgets),
    "that says 10 % of its looks twice": Lie(_stutters),
    "that is 100 ms late": Lie(lag=0.1),
    "that is 200 ms late": Lie(lag=0.2),
    "that is wrong in 1 % of its looks": Lie(_flips(0.01)),
    "that is wrong in 20 % of its looks": Lie(_flips(0.2)),
    "that says its last three looks in any order": Lie(_mixes),
    "that always says the look before": Lie(lambda draw: lambda looks: line(looks[-2:][0])),
}


class Past:
    """Looks by their times: what was seen `lag` (s) ago; the first look, where that is too long."""

    def __init__(self, lag: float) -> None:
        self._lag = lag
        self._seen = deque[tuple[float, Look]]()

    def saw(self, look: Look, now: float) -> None:
        """Note a look."""
        self._seen.append((now, look))

    def look(self, now: float) -> Look:
        """The look of then."""
        while len(self._seen) > 1 and self._seen[1][0] <= now - self._lag:
            self._seen.popleft()
        return self._seen[0][1]


class Lagging:
    """Looks through a probe all the time; `look` is what it saw `lag` (s) ago."""

    def __init__(self, probe: Probe, lag: float) -> None:
        self._probe, self._past = probe, Past(lag)
        self._past.saw(probe.look(), time.monotonic())
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def _look(self) -> None:
        while not self._over.wait(_STEP):
            self._past.saw(self._probe.look(), time.monotonic())

    def look(self) -> Look:
        """The look of then."""
        return self._past.look(time.monotonic())

    def close(self) -> None:
        """End the looking."""
        self._over.set()
        self._thread.join()


class LyingProbe(LocalServer):
    """Serves a probe over TCP, one client at a time, that lies of what the probe `name` sees."""

    def __init__(self, name: str, lie: Lie, draw: Random) -> None:
        self._true, self._lag, self._tell = name, lie.lag, lie.drawn(draw)
        super().__init__(self._serve)
        self.name = f"tcp:{self.address}"

    def _serve(self) -> None:
        with ExitStack() as stack:
            probe = stack.enter_context(closing(Probe(self._true)))
            eye = stack.enter_context(closing(Lagging(probe, self._lag))) if self._lag else probe
            looks: list[Look] = []
            while not self._over.is_set():
                if not select.select([self._listener], [], [], _POLL)[0]:
                    continue
                with suppress(OSError), self._listener.accept()[0] as client:
                    self._answer(client, eye, looks)

    def _answer(self, client: socket.socket, eye: Probe | Lagging, looks: list[Look]) -> None:
        """Answer a client until it hangs up or the probe ends."""
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while not self._over.is_set():
            if not select.select([client], [], [], _POLL)[0]:
                continue
            asked = client.recv(1 << 12)
            if not asked:
                return
            for _ in range(asked.count(b"\n")):
                looks.append(eye.look())
                client.sendall(self._tell(looks))


def _lied_to(lie: Lie) -> Hurt:
    def between(stack: ExitStack, robot: Served, draw: Random) -> tuple[str, str]:
        return robot.port, stack.enter_context(LyingProbe(robot.probe.name, lie, draw)).name

    return Hurt(between)


HURTS = {f"with a probe {what}": _lied_to(lie) for what, lie in LIES.items()}


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    return measure(HURTS, FAULTY, runs, seed, progress)


HARM = Harm("probes", "the suite with probes that lie", 6 * len(HURTS), _measure)
