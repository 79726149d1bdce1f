"""One direction of a faulty line: bytes in, and out again when they are due. No port, no clock.

Chance is drawn byte by byte, so the same seed and the same bytes give the same faults however the
bytes come in pieces. The times are drawn apart from the harm: a line with and one without a delay
drop the same bytes.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from random import Random

from analyzer.taps.noise import Noise

LONGEST = 60_000_000_000  # ns that a byte may be held back


@dataclass(frozen=True, slots=True)
class LineFaults:
    """What a line does to its bytes: noise, and times.

    A byte is held back by `delay` ns with the chance `late` (0 to 1), and by 0 to `jitter` ns more,
    evenly drawn; a byte that is not late is not held back at all. Raises ValueError for a chance
    outside 0 to 1 and for times below 0 or above 60 s.
    """

    noise: Noise = field(default_factory=Noise)
    delay: int = 0
    jitter: int = 0
    late: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.late <= 1:
            raise ValueError(f"the chance to be late is {self.late:g}, allowed are 0 to 1")
        if min(self.delay, self.jitter) < 0 or self.delay + self.jitter > LONGEST:
            raise ValueError(
                f"delay and jitter are {self.delay / 1e6:g} and {self.jitter / 1e6:g} ms, allowed "
                f"are times from 0, together at most {LONGEST // 10**9} s"
            )


class Lane:
    """One direction of a faulty line; `name` ("A to B") makes the chances of two lanes differ.

    `came` counts the bytes that were put in, `dropped`, `flipped`, `doubled` and `delayed` what
    happened to how many of them. A byte that only waits behind a delayed one is not counted.
    """

    def __init__(self, faults: LineFaults, seed: int, name: str) -> None:
        self.name = name
        self.came = self.dropped = self.flipped = self.doubled = self.delayed = 0
        self._faults = faults
        self._harm = Random(f"{seed} harm {name}")
        self._times = Random(f"{seed} times {name}")
        self._waiting: deque[tuple[int, bytearray]] = deque()  # when they are due, in order

    @property
    def deadline(self) -> int | None:
        """When, in ns, the next bytes are due; None when nothing is on its way."""
        return self._waiting[0][0] if self._waiting else None

    def put(self, data: bytes, now: int) -> None:
        """Take bytes that came at `now`, in ns, which never goes back."""
        for byte in data:
            self.came += 1
            harm, arriving = self._faults.noise.strike(byte, self._harm)
            held = self._held()
            if harm:
                setattr(self, harm, getattr(self, harm) + 1)
            if arriving:
                self.delayed += held > 0
                self._send(arriving, now + held)

    def take(self, now: int) -> bytes:
        """Return what is due at `now`, in ns, in the order in which it came."""
        due = bytearray()
        while self._waiting and self._waiting[0][0] <= now:
            due += self._waiting.popleft()[1]
        return bytes(due)

    def account(self) -> str:
        """What passed and what happened to it, in words."""
        return (
            f"{self.name}: {self.came} bytes, {self.dropped} dropped, {self.flipped} flipped, "
            f"{self.doubled} doubled, {self.delayed} delayed"
        )

    def _held(self) -> int:
        """Draw how long the next byte is held back, in ns; each byte draws as often."""
        late, more = self._times.random(), self._times.random()
        if late >= self._faults.late:
            return 0
        return self._faults.delay + round(more * self._faults.jitter)

    def _send(self, data: bytes, due: int) -> None:
        """Send `data` on its way, but not past what is on its way already."""
        if self._waiting and due <= self._waiting[-1][0]:
            self._waiting[-1][1].extend(data)
        else:
            self._waiting.append((due, bytearray(data)))
