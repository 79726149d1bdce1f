"""A line that is made unreliable: it flips, drops, doubles and delays bytes at random.

Random numbers are drawn byte by byte, so the same seed and the same bytes give the same faults,
whatever the chunks are. Delays have a random generator of their own: a line with a delay and one
without drop the same bytes.

Two ends are connected by it until a stop is requested, in one thread with one loop. Bytes are kept
only for their delay, or for a peer that does not read: at most 64 KiB, for 1 s.
"""

from __future__ import annotations

import select
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import TypeAlias

from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.port import Forward, Port, PtyPair, open_port, open_pty
from bilprov.analyzer.transport.signals import Stopper


@dataclass(frozen=True, slots=True)
class Noise:
    """The probabilities (0 to 1) that a byte is flipped in one bit, dropped, or doubled.

    Raises ValueError if together they exceed 1.
    """

    flipped: float = 0.0
    dropped: float = 0.0
    doubled: float = 0.0

    def __post_init__(self) -> None:
        chances = (self.flipped, self.dropped, self.doubled)
        if sum(chances) > 1:
            raise ValueError(f"the rates are {chances}: each is 0 to 1, together at most 1")

    def impair(self, byte: int, chance: Random) -> tuple[str, bytes]:
        """Apply the noise to a byte; return the effect ("" for none) and the bytes that arrive."""
        drawn = chance.random()
        if drawn < self.flipped:
            return "flipped", bytes([byte ^ 1 << chance.randrange(8)])
        if drawn < self.flipped + self.dropped:
            return "dropped", b""
        if drawn < self.flipped + self.dropped + self.doubled:
            return "doubled", bytes([byte, byte])
        return "", bytes([byte])


class ImpairedDirection:
    """One direction of a faulty line; `name` ("A to B") is part of its random seed.

    A byte is held back by `delay` ns plus 0 to `jitter` ns, evenly distributed.
    `came` counts the bytes that were put in; `dropped`, `flipped`, `doubled` and `delayed` count
    the affected ones. A byte that only waits behind a delayed one does not count as delayed.
    """

    def __init__(
        self, noise: Noise, seed: int, name: str, *, delay: int = 0, jitter: int = 0
    ) -> None:
        self.name = name
        self.came = self.dropped = self.flipped = self.doubled = self.delayed = 0
        self._noise, self._delay, self._jitter = noise, delay, jitter
        self._harm = Random(f"{seed} harm {name}")
        self._times = Random(f"{seed} times {name}")
        self._waiting: deque[tuple[int, bytes]] = deque()  # due time (ns) and bytes, in order

    @property
    def deadline(self) -> int | None:
        """When (ns) the next bytes are due, None if none are waiting."""
        return self._waiting[0][0] if self._waiting else None

    def put(self, data: bytes, now: int) -> None:
        """Put in bytes that came at `now` (ns); `now` never goes back."""
        for byte in data:
            self.came += 1
            harm, arriving = self._noise.impair(byte, self._harm)
            self._times.random()  # once chose late bytes; with it a seed still means the same times
            held = self._delay + round(self._times.random() * self._jitter)
            if harm:
                setattr(self, harm, getattr(self, harm) + 1)
            if arriving:
                self.delayed += held > 0
                earlier = self._waiting[-1][0] if self._waiting else 0  # which it does not overtake
                self._waiting.append((max(now + held, earlier), arriving))

    def take(self, now: int) -> bytes:
        """Take out the bytes that are due at `now` (ns), in the order in which they came."""
        due = bytearray()
        while self._waiting and self._waiting[0][0] <= now:
            due += self._waiting.popleft()[1]
        return bytes(due)

    def account(self) -> str:
        """The counts of bytes and faults, in words."""
        return (
            f"{self.name}: {self.came} bytes, {self.dropped} dropped, {self.flipped} flipped, "
            f"{self.doubled} doubled, {self.delayed} delayed"
        )


End: TypeAlias = Port | PtyPair

PTY = "pty"  # the name of an end that is made for others to open
_RETRY = 1_000_000  # ns between attempts to forward bytes that a peer did not take


def open_end(name: str, settings: LineSettings) -> End:
    """Open an end: a new pty, or the device at a port. Raises LinkError."""
    return open_pty() if name == PTY else open_port(name, settings)


def join(
    ends: tuple[End, End],
    directions: tuple[ImpairedDirection, ImpairedDirection],
    *,
    stop: Stopper,
    note: Callable[[str], None],
) -> None:
    """Forward bytes from the first end through the first lane to the second, and back by the other.

    Returns once `stop` is readable. `note` gets a sentence when a peer does not read. Raises the
    LinkError of a lost end, after all bytes from it have been forwarded. Forwarded bytes that no
    program has read from a pty are lost when the pty is closed.
    """
    outs = [
        Forward(peer.write_some, f"nobody reads what goes from {direction.name}")
        for peer, direction in zip(reversed(ends), directions, strict=True)
    ]
    ways = list(zip(ends, directions, outs, strict=True))
    lost: dict[End, LinkError] = {}
    while True:
        now = time.monotonic_ns()
        turns = [way.deadline for way in directions if way.deadline is not None]
        turns += [now + _RETRY for out in outs if out.owed]
        patience = max(0, min(turns) - now) / 1e9 if turns else None
        starts = [end for end in ends if end not in lost]
        if stop in select.select([stop, *starts], [], [], patience)[0]:
            return
        for start, direction, _ in ways:
            try:
                direction.put(b"" if start in lost else start.read(), time.monotonic_ns())
            except LinkError as error:
                lost[start] = error
        for start, direction, out in ways:
            now = time.monotonic_ns()
            complaint = out.push(direction.take(now), now)
            if start in lost and direction.deadline is None and not out.owed:
                raise lost[start]
            if complaint:
                note(complaint)
