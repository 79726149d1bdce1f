"""The profile of a device under test: its measured times, and its choices at open points."""

from __future__ import annotations

from dataclasses import dataclass, field

from bilprov.conformance.dut.operations import Received
from bilprov.conformance.oracle.choices import Choices
from bilprov.spec.motion import Motion


@dataclass
class Profile:
    """What was measured on the device; times in ns, None where it was not.

    `flushes` is true for a device that discards what follows a fault until the line is idle,
    `whole_frame` for one whose time-out counts over the whole frame. `stop_latency` is how late it
    was seen to stop, `watchdog` the silence after which it stopped by itself, `boot` the time to
    the first answer; `one_by_one` is true where instructions that are sent ahead are lost.
    `moves` are the kinds of motion in which it was seen moving.
    `round_trip` and `jitter` are the line's and the device's together. `choices` are those that the
    device has shown where the document is silent.
    """

    truncation_timeout: int | None = None
    truncation_answered: bool | None = None
    latencies: list[int] = field(default_factory=list)
    slowest: int = 0
    flushes: bool = False
    whole_frame: bool = False
    watchdog: int | None = None
    round_trip: int | None = None
    jitter: int | None = None
    boot: int | None = None
    stop_latency: int = 0
    one_by_one: bool = False
    moves: set[Motion] | None = None
    choices: Choices = field(default_factory=Choices)

    def measured(self, heard: Received, sent: int) -> None:
        """Add the latency of the first answer, if any, to a frame that had gone at `sent` (ns)."""
        for t, _ in heard.answers[:1]:
            if t >= sent:  # else it came by itself
                self.latencies.append(t - sent)
                self.slowest = max(self.slowest, t - sent)
