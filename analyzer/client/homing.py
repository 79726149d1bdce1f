"""Brings a robot to a stop between two frames, from wherever it is; nothing is judged here."""

from __future__ import annotations

from collections.abc import Callable

from analyzer.decode.pairing import MILLISECOND
from analyzer.transport.wire import Wire
from spec.protocol import Protocol

_TRIES = 5  # an opened Arduino resets, and boots for some seconds
_SLOWER = 4  # how much later than the first answer one of the others may come
_SETTLE = 2 * MILLISECOND  # how close behind the last answer one too many comes


def home(protocol: Protocol, wire: Wire, given_up: Callable[[], bool] = lambda: False) -> bool:
    """Home again and again until the robot answers; tell whether it did.

    `given_up` is asked after each try that was not answered.
    """
    for _ in range(_TRIES):
        if home_once(protocol, wire):
            return True
        if given_up():
            break
    return False


def home_once(protocol: Protocol, wire: Wire) -> bool:
    """Fill up whatever frame the robot may be in, with stops; tell whether it answered.

    Stops that a robot takes as data it is owed have no answer of their own: after a pause in which
    nothing comes, it is owed none any more. A slow robot is given more, by its first answer.
    """
    timing = protocol.timing
    count = protocol.longest_frame
    wire.listen(None, 0)
    sent = wire.send(stops(protocol))
    heard = 0
    patience = round(timing.answer_longest * MILLISECOND)
    pause = round(max(timing.answer_deadline, timing.truncation_timeout) * MILLISECOND)
    while heard < count and (more := wire.listen(1, patience)):
        if not heard:
            patience = max(pause, _SLOWER * (more[0][0] - sent))
        heard += len(more)
    wire.listen(None, _SETTLE)
    return heard > 0


def stops(protocol: Protocol) -> bytes:
    """So many stops that the longest frame is full and one is left over."""
    return bytes([protocol.filler]) * protocol.longest_frame
