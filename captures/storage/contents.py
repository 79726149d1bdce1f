"""The results of one survey pass over a capture file: values only."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Contents:
    """The results of a survey. Times are `log_time` in ns, 0 if there is no message.

    `size` is the file's size in bytes; `regions` are its ranges of complete records, as the first
    byte and the byte after the last. `own` is true if bilprov recorded the file, so that the order
    in the file is the order of events; `counted` is true if no other program rewrote it since, so
    that a jump of `sequence` is a loss. `starts` are the file's statements of its start (digits,
    ns), the best protected one first. `channels` maps channel ids to topic and encoding; `counts`
    and `sizes` are messages and bytes by topic.
    """

    size: int
    regions: tuple[tuple[int, int], ...]
    own: bool
    counted: bool
    library: str
    metadata: dict[str, str]
    starts: tuple[str, ...]
    channels: dict[int, tuple[str, str]]
    first: int
    last: int
    counts: dict[str, int]
    sizes: dict[str, int]
    unfinished: bool
    damage: tuple[str, ...]


@dataclass(slots=True)
class Tally:
    """Counts of messages and bytes by channel id, and the times, of one chunk or of a file."""

    counts: Counter[int] = field(default_factory=Counter)
    sizes: Counter[int] = field(default_factory=Counter)
    times: list[int] = field(default_factory=list)  # first, earliest, latest
    too_long: int = 0
    bad_lines: int = 0

    def message(self, channel: int, time: int, size: int) -> None:
        """Count one message."""
        self.counts[channel] += 1
        self.sizes[channel] += size
        if not self.times:
            self.times = [time, time, time]
        elif time > self.times[2]:
            self.times[2] = time
        elif time < self.times[1]:
            self.times[1] = time

    def add(self, other: Tally) -> None:
        """Add the counts of another tally, whose messages come later in the file."""
        self.counts.update(other.counts)
        self.sizes.update(other.sizes)
        if not self.times:
            self.times = other.times
        elif other.times:
            self.times[1] = min(self.times[1], other.times[1])
            self.times[2] = max(self.times[2], other.times[2])
        self.too_long += other.too_long
        self.bad_lines += other.bad_lines
