"""Homes a robot: as many stops as the longest frame has bytes bring it to rest from any state."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from bilprov.analyzer.client.operations import Procedure, listen, send
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.port import Port
from bilprov.captures.schemas import MS
from bilprov.spec.protocol import Protocol

_TRIES = 5  # an opened Arduino resets, and boots for some seconds
_SLOWER = 4  # how much later than the first answer one of the others may come
_SETTLE = 2 * MS  # ns after the last answer in which a surplus answer comes


def stops(protocol: Protocol) -> bytes:
    """Stop instructions, as many as the longest frame has bytes.

    They fill any open frame, and at least one is left over as an instruction.
    """
    return bytes([protocol.pad_byte]) * protocol.longest_frame


def halt(protocol: Protocol, port: Port) -> None:
    """Send the stops, as far as the line allows, and wait for nothing."""
    with suppress(LinkError):
        port.write(stops(protocol))


def home(protocol: Protocol, given_up: Callable[[], bool] = lambda: False) -> Procedure[bool]:
    """Home until the robot answers, in a limited number of tries; return whether it did.

    `given_up` is called after each try without an answer; if it returns true, no more are made.
    """
    for _ in range(_TRIES):
        if (yield from home_once(protocol)):
            return True
        if given_up():
            break
    return False


def home_once(protocol: Protocol) -> Procedure[bool]:
    """Send stops to complete any frame the robot may be in; return whether it answered.

    Stops that the robot takes as missing data have no answer of their own, so the wait ends after
    a pause without an answer. The first answer's latency lengthens that pause for a slow robot.
    """
    timing = protocol.timing
    yield from listen(None, 0)
    sent = yield from send(stops(protocol))
    heard = 0
    patience = round(timing.answer_longest * MS)
    pause = round(max(timing.answer_deadline, timing.truncation_timeout) * MS)
    while heard < protocol.longest_frame:
        more = yield from listen(1, patience)
        if not more.answers:
            break
        if not heard:
            patience = max(pause, _SLOWER * (more.answers[0][0] - sent))
        heard += len(more.answers)
    yield from listen(None, _SETTLE)
    return heard > 0
