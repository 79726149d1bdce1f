"""Impairs a line: flips, drops, doubles and delays bytes at random. Uses no port and no clock.

Random numbers are drawn byte by byte, so the same seed and the same bytes give the same faults,
whatever the chunks are. Delays have a random generator of their own: a line with a delay and one
without drop the same bytes.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from random import Random

LONGEST = 60_000_000_000  # ns that a byte may be held back


@dataclass(frozen=True, slots=True)
class Noise:
    """The probabilities (0 to 1) that a byte is flipped in one bit, dropped, or doubled.

    Raises ValueError for a probability outside 0 to 1, and if together they exceed 1.
    """

    flipped: float = 0.0
    dropped: float = 0.0
    doubled: float = 0.0

    def __post_init__(self) -> None:
        chances = (self.flipped, self.dropped, self.doubled)
        if not (all(chance >= 0 for chance in chances) and sum(chances) <= 1):  # nor is nan
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


@dataclass(frozen=True, slots=True)
class LineFaults:
    """The faults of a line: noise and delays.

    A byte is held back by `delay` ns plus 0 to `jitter` ns, evenly distributed. Raises ValueError
    for times below 0 or, together, above 60 s.
    """

    noise: Noise = field(default_factory=Noise)
    delay: int = 0
    jitter: int = 0

    def __post_init__(self) -> None:
        if min(self.delay, self.jitter) < 0 or self.delay + self.jitter > LONGEST:
            raise ValueError("delay and jitter are times from 0, together at most 60 s")


class ImpairedDirection:
    """One direction of a faulty line; `name` ("A to B") is part of its random seed.

    `came` counts the bytes that were put in; `dropped`, `flipped`, `doubled` and `delayed` count
    the affected ones. A byte that only waits behind a delayed one does not count as delayed.
    """

    def __init__(self, faults: LineFaults, seed: int, name: str) -> None:
        self.name = name
        self.came = self.dropped = self.flipped = self.doubled = self.delayed = 0
        self._faults = faults
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
            harm, arriving = self._faults.noise.impair(byte, self._harm)
            self._times.random()  # once chose late bytes; with it a seed still means the same times
            held = self._faults.delay + round(self._times.random() * self._faults.jitter)
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
