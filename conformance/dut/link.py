"""The interface of a device, and the environment of a run.

That is what, besides grammar and options, is needed to repeat it.
"""

from __future__ import annotations

from typing import Any, Protocol

import msgspec

from bilprov.captures.schemas import Look


class Observability(msgspec.Struct, frozen=True, rename={"available": "open", "costly": "sparse"}):
    """What a probe can see: nothing (`available` false), everything, or a few looks (`costly`).

    `why` says why something is not observable. A `foreign` probe is not the kit's own: single looks
    through it may be wrong. Recordings keep the fields under older names.
    """

    available: bool
    costly: bool = False
    why: str = "no probe; see --probe"
    foreign: bool = False


class Environment(msgspec.Struct, frozen=True, rename={"observability": "eyes"}):
    """Where and how a run takes place.

    `virtual` is true for a device object in virtual time, false for a port. `observability` says
    what can be observed, `power` whether the robot can be switched off and on. `device` and `link`
    describe the device and the link in the report only. `lossless` declares that nothing on the
    line is lost, changed or doubled: what is unexplained there is the device's, even if met once.
    `announced` is how long (s) the run was said to take, where it is to end if it takes three times
    as long; None for no limit.
    """

    virtual: bool
    observability: Observability
    power: bool
    device: str
    link: dict[str, Any]
    lossless: bool = False
    announced: float | None = None


class Device(Protocol):
    """A device under test without I/O: bytes and times (ns) in, answers and looks out.

    Time begins at 0 with each run: each needs an object of its own. One without `look` is judged by
    its answers alone. One with an attribute `lossless` that is True declares that nothing between
    it and the suite is lost: a single unexplained mismatch is then a failure. One with a method
    `power_cycle(now)`, which switches it off and on, is tried after power-on from a motion too.
    """

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that arrive at `now`."""

    def advance(self, now: int) -> bytes:
        """Let time pass until `now`; return the bytes the device has sent until then."""

    def deadline(self) -> int | None:
        """When (ns) the device next acts by itself, None if it only waits for bytes."""

    def look(self, now: int) -> Look:
        """What the wheels and the LED do at `now`."""
