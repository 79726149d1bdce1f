"""The operations of a procedure (send, listen, observe, power-cycle), and what runs it over a link.

A link does them; whatever drives a robot reaches it in no other way. Times are integers in
nanoseconds on the link's clock, virtual or real.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias, TypeVar

import msgspec

from bilprov.analyzer.transport.errors import LinkError
from bilprov.captures.schemas import Look

T = TypeVar("T")
Step = TypeVar("Step")


Heard: TypeAlias = tuple[tuple[int, int], ...]
"""Answer bytes, each as (time in ns, byte)."""


class Send(msgspec.Struct, frozen=True, gc=False):
    """Send these bytes; the reply is the time (ns) when the last one was sent."""

    data: bytes


class Listen(msgspec.Struct, frozen=True, gc=False):
    """Wait until `count` answer bytes have come or `patience` ns are over.

    With `count` None it waits the whole time. The reply is Received: all that came since the last
    Listen.
    """

    count: int | None
    patience: int


class Observe(msgspec.Struct, frozen=True, gc=False):
    """Look at the robot through the probe; the reply is an Observation."""


class PowerCycle(msgspec.Struct, frozen=True, gc=False):
    """Switch the robot off and on; the reply is the time (ns) when it is on again."""


class Received(msgspec.Struct, frozen=True, gc=False):
    """What was heard, and the time (ns) when listening ended."""

    answers: Heard
    now: int

    @property
    def codes(self) -> tuple[int, ...]:
        """The bytes alone."""
        return tuple(code for _, code in self.answers)

    def __add__(self, more: Received) -> Received:
        """What was heard, and what came after it."""
        return Received(self.answers + more.answers, more.now)


class Observation(NamedTuple):
    """A look with the times (ns) when the probe was asked and when its reply was complete."""

    asked: int
    now: int
    look: Look


Operation = Send | Listen | Observe | PowerCycle
Reply = int | Received | Observation
"""What a link gives for an operation; an int is the time (ns) when it was done."""

Procedure = Generator[Operation, Any, T]


def send(data: bytes) -> Procedure[int]:
    """Send bytes; returns the time (ns) when the last one was sent."""
    sent: int = yield Send(data)
    return sent


def listen(count: int | None, patience: int) -> Procedure[Received]:
    """Listen for `count` answers, for at most `patience` ns; returns what was received."""
    heard: Received = yield Listen(count, patience)
    return heard


def power_cycle() -> Procedure[int]:
    """Switch the robot off and on; returns the time (ns) when it is on again."""
    now: int = yield PowerCycle()
    return now


def observe() -> Procedure[Observation]:
    """Look at the robot through the probe; returns the observation."""
    seen: Observation = yield Observe()
    return seen


EndedBy = Literal["error", "user", "time"]
"""What can end a run early."""


class Ended(Exception):
    """The run cannot go on: raised by a link, and thrown into the procedure, with one sentence.

    `by` is `error` when the kit, the port or the probe failed, `user` when the user interrupted,
    `time` when the run took too long; `error` alone chooses between the first two. `line_works`
    tells whether the robot can still be homed.
    """

    def __init__(
        self, sentence: str, *, error: bool, line_works: bool, by: EndedBy | None = None
    ) -> None:
        super().__init__(sentence)
        self.error = error
        self.line_works = line_works
        self.by: EndedBy = by or ("error" if error else "user")


class Follower(Protocol):
    """Takes note of the operations of a procedure."""

    def did(self, operation: Operation, reply: Reply) -> None:
        """Take note of an operation that was done."""


def followed(
    procedure: Procedure[T],
    *followers: Follower,
    look: Callable[[], Procedure[Observation]] = observe,
) -> Procedure[T]:
    """The procedure, every operation of which the followers take note of; `look` does its looks."""

    def do(operation: Operation) -> Procedure[Reply]:
        reply: Reply = (yield from look()) if isinstance(operation, Observe) else (yield operation)
        for follower in followers:
            follower.did(operation, reply)
        return reply

    return _performed(procedure, do)


def _performed(
    procedure: Procedure[T], do: Callable[[Operation], Generator[Step, Any, Reply]]
) -> Generator[Step, Any, T]:
    """Run a procedure whose operations `do` does; what ends one is thrown into the procedure."""
    reply: Reply | None = None
    error: Ended | None = None
    while True:
        try:
            operation = procedure.throw(error) if error else procedure.send(reply)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]  # what the generator's type says
        error = None
        try:
            reply = yield from do(operation)
        except Ended as ended:
            error = ended


class Reconnected(Ended):
    """The port was lost and is there again: the case under way is over, and the run can go on.

    The port was missed at `lost` and there again at `now` (ns). Where nothing can go on, before the
    first case, it ends the run as a port that is lost does.
    """

    def __init__(self, sentence: str, lost: int, now: int) -> None:
        super().__init__(sentence, error=False, line_works=True, by="error")
        self.lost = lost
        self.now = now


OperationName = Literal["send", "listen", "look", "power", "interrupt"]


OPERATION_NAMES: dict[type, OperationName] = {
    Send: "send",
    Listen: "listen",
    Observe: "look",
    PowerCycle: "power",
    type(None): "interrupt",
}
"""The name of each operation in a recording; None stands for an interruption."""


HELD_ANSWERS = 1 << 13
"""Answer bytes kept between two operations: a device that floods must not fill the memory."""


class LinkListener:
    """Is told everything that passes over a link; times are in ns. Does nothing here."""

    def sent(self, data: bytes, t: int) -> None:
        """Bytes that go to the device."""

    def received(self, data: bytes, t: int) -> None:
        """Bytes that came from it."""

    def looked(self, look: Look) -> None:
        """A reading of the probe."""


class Link(Protocol):
    """The connection to a robot: does operations, one at a time."""

    def do(self, operation: Operation) -> Reply:
        """Do one operation. Raises analyzer.client.operations.Ended when it cannot."""


def drive(
    procedure: Procedure[T], link: Link, interrupted: Callable[[], bool | str] = lambda: False
) -> T:
    """Run a procedure over a link to its end and return what it returns; see `steps`."""
    return finished(steps(procedure, link, interrupted))


def finished(steps_left: Generator[None, None, T]) -> T:
    """Do all that is left and return what it comes to."""
    while True:
        try:
            next(steps_left)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]  # what the generator's type says


def steps(
    procedure: Procedure[T], link: Link, interrupted: Callable[[], bool | str]
) -> Generator[None, None, T]:
    """Run a procedure over a link, and yield after each of its operations; returns what it does.

    `interrupted` is called before and after each operation. The first time that it returns True
    (the user's wish) or a sentence (what of the kit failed), Ended is thrown into the procedure,
    which then only homes the robot. What the operation brought is not judged: it was cut short.
    """
    told = False

    def end_if_interrupted() -> None:
        nonlocal told
        if not told and (why := interrupted()):
            told = True
            raise interruption(why)

    def do(operation: Operation) -> Generator[None, None, Reply]:
        try:
            end_if_interrupted()
            reply = link.do(operation)
            end_if_interrupted()
            return reply
        finally:
            yield

    return _performed(procedure, do)


def done(procedure: Procedure[T], link: Link) -> T:
    """Run a procedure over a link and return what it returns.

    Raises LinkError, or what else it was that the link failed of.
    """
    try:
        return drive(procedure, link)
    except Ended as ended:
        failed = ended.__cause__ or LinkError(str(ended))
    raise failed  # out here: one of the two would be the other's context, and that its cause


def interruption(why: bool | str) -> Ended:
    """The Ended for an interruption: True is the user's wish, a sentence a failure of the kit."""
    failed = isinstance(why, str)
    return Ended(str(why) if failed else "interrupted", error=failed, line_works=True)
