"""Interfaces of a link and its listener, and what runs a procedure over a link."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from bilprov.analyzer.client.operations import Ended, Operation, Procedure, Reply
from bilprov.analyzer.transport.errors import LinkError
from bilprov.captures.schemas import Look

T = TypeVar("T")

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
