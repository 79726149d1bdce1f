"""What one pass over a capture file found: values only."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Contents:
    """What a survey found. Times are `log_time` in ns, 0 where there is no message.

    `size` is the file's in bytes; `regions` are its stretches of whole records, as first byte and
    byte after the last. `own` says that bilprov recorded it, so that the order in the file is the
    order of events; `counted` that no other program rewrote it since, so that a jump of `sequence`
    is a loss. `starts` are what the file says of its start (digits, ns), best vouched for first.
    `channels` gives topic and encoding by channel id; `counts` and `sizes` are messages and bytes
    by topic.
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
    """Messages and bytes by channel id, and the times, of one chunk or of a file."""

    counts: dict[int, int] = field(default_factory=dict)
    sizes: dict[int, int] = field(default_factory=dict)
    times: list[int] = field(default_factory=list)  # first, earliest, latest
    too_long: int = 0
    bad_lines: int = 0

    def message(self, channel: int, time: int, size: int) -> None:
        """Count one message."""
        self.counts[channel] = self.counts.get(channel, 0) + 1
        self.sizes[channel] = self.sizes.get(channel, 0) + size
        if not self.times:
            self.times = [time, time, time]
        elif time > self.times[2]:
            self.times[2] = time
        elif time < self.times[1]:
            self.times[1] = time

    def add(self, other: Tally) -> None:
        """Count what another tally counted, as coming later in the file."""
        for channel, count in other.counts.items():
            self.counts[channel] = self.counts.get(channel, 0) + count
            self.sizes[channel] = self.sizes.get(channel, 0) + other.sizes[channel]
        if not self.times:
            self.times = other.times
        elif other.times:
            self.times[1] = min(self.times[1], other.times[1])
            self.times[2] = max(self.times[2], other.times[2])
        self.too_long += other.too_long
        self.bad_lines += other.bad_lines
