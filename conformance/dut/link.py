"""Interfaces of device, link and listener, and `drive`, which runs a procedure over a link.

Also the environment: what, besides grammar and options, is needed to repeat a run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import msgspec

from bilprov.captures.schemas import Look
from bilprov.conformance.dut.operations import Ended, Operation, Procedure, Reply

T = TypeVar("T")


HELD_ANSWERS = 1 << 13
"""Answer bytes kept between two operations: a device that floods must not fill the memory."""


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


class LinkListener:
    """Is told everything that passes over a link; times are in ns. Does nothing here."""

    def sent(self, data: bytes, t: int) -> None:
        """Bytes that go to the device."""

    def received(self, data: bytes, t: int) -> None:
        """Bytes that came from it."""

    def looked(self, look: Look) -> None:
        """A reading of the probe."""


class Link(Protocol):
    """The connection to a device under test: does operations, one at a time."""

    def do(self, operation: Operation) -> Reply:
        """Do one operation. Raises conformance.dut.operations.Ended when it cannot."""


def drive(procedure: Procedure[T], link: Link, interrupted: Callable[[], bool | str]) -> T:
    """Run a procedure over a link to its end and return what it returns.

    `interrupted` is called before and after each operation. The first time that it returns True
    (the user's wish) or a sentence (what of the kit failed), Ended is thrown into the procedure,
    which then only homes the robot. What the operation brought is not judged: it was cut short.
    """
    reply: Any = None
    error: BaseException | None = None
    told = False

    def end_if_interrupted() -> None:
        nonlocal told
        if not told and (why := interrupted()):
            told = True
            raise interruption(why)

    while True:
        try:
            operation = procedure.throw(error) if error else procedure.send(reply)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]  # what the generator's type says
        error = None
        try:
            end_if_interrupted()
            reply = link.do(operation)
            end_if_interrupted()
        except Ended as ended:
            error = ended


def interruption(why: bool | str) -> Ended:
    """The Ended for an interruption: True is the user's wish, a sentence a failure of the kit."""
    failed = isinstance(why, str)
    return Ended(str(why) if failed else "interrupted", error=failed, line_works=True)
