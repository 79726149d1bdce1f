"""Answers each ask out of a recording: the same bytes at the same times, the same looks, no device.

What the runner sends must be what was recorded as sent; where it asks for anything else the
recording cannot answer, and `Strayed` says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import msgspec

from captures import topics
from captures.reader import Message
from captures.schemas import Asked, Look
from conformance.dut.link import HELD
from conformance.dut.operations import Ask, Heard, Listen, PowerCycle, See, Seen, Send
from conformance.runner.listeners.recorder import NAMES
from conformance.runner.run import Ended
from spec.codec import spaced

TOPICS = frozenset({topics.HOST_RAW, topics.DEVICE_RAW, topics.LOOKS, topics.ASKS})
"""What a recording is read for: bytes, looks, and when each ask was done. No verdict is."""

CUT = "the recording ends here"

_SHOWN = 16  # bytes of a frame in a sentence
Read = TypeVar("Read", Asked, Look)


class Strayed(Exception):
    """The run asks for something else than was recorded, in one sentence."""


@dataclass(slots=True)
class _Step:
    """One recorded ask with what it brought."""

    asked: Asked
    sent: bytes
    received: list[tuple[int, int]]
    look: Look | None


class RecordedLink:
    """A link over the messages of a recording, in their order and of `TOPICS` alone.

    `cut` tells that the recording ended before the run did.
    """

    def __init__(self, messages: Iterator[Message]) -> None:
        self.cut = False
        self._messages = messages
        self._heard: list[tuple[int, int]] = []
        self._number = 0
        self._next = self._read()

    @property
    def left(self) -> bool:
        """Whether more was recorded than was asked for."""
        return self._next is not None

    def interrupted(self) -> bool | str:
        """Whether the run was told to end before its next ask, and if it failed itself, why."""
        if self._next is None or self._next.asked.ask != NAMES[type(None)]:
            return False
        asked = self._take(self._next).asked
        return str(asked.ended) if asked.error else True

    def do(self, ask: Ask) -> int | Heard | Seen:
        """Reply as it was recorded.

        Raises Ended where the ask could not be done, or the recording ends; Strayed where another
        ask was recorded.
        """
        step = self._next
        if step is None:
            self.cut = True
            raise Ended(CUT, error=False, line_works=False)
        self._check(ask, step)
        asked = self._take(step).asked
        if asked.ended is not None:
            works = bool(asked.line_works)
            raise Ended(asked.ended, error=bool(asked.error), line_works=works)
        match ask:
            case Listen():
                heard, self._heard = self._heard, []
                return Heard(tuple(heard[:HELD]), asked.t)
            case See():
                assert step.look is not None
                assert asked.begun is not None
                return Seen(asked.begun, asked.t, step.look)
            case PowerCycle():
                self._heard = []
        return asked.t

    def _check(self, ask: Ask, step: _Step) -> None:
        name, recorded = NAMES[type(ask)], step.asked
        wanted = ask.data if isinstance(ask, Send) else b""
        if recorded.ask != name:
            raise Strayed(f"{self._where} is {recorded.ask!r}, the kit now asks for {name!r}")
        if step.sent != wanted and (recorded.ended is None or step.sent):
            raise Strayed(f"{self._where} sends {_hex(step.sent)}, the kit now {_hex(wanted)}")
        seen = step.look is not None and recorded.begun is not None
        if isinstance(ask, See) and recorded.ended is None and not seen:
            raise Strayed(f"{self._where} is a look, and nothing was seen")

    @property
    def _where(self) -> str:
        return f"step {self._number} of the recording"

    def _take(self, step: _Step) -> _Step:
        """The step is done: what came during it is heard, and the next one is read."""
        self._heard += step.received
        self._next = self._read()
        return step

    def _read(self) -> _Step | None:
        """The next ask with all that stands before it, None where the recording ends."""
        sent, received, look = bytearray(), list[tuple[int, int]](), None
        self._number += 1
        for message in self._messages:
            value = message.value
            if message.topic == topics.LOOKS:
                look = self._value(value, Look)
            elif message.topic == topics.ASKS:
                return _Step(self._value(value, Asked), bytes(sent), received, look)
            elif isinstance(value, bytes) and message.topic == topics.HOST_RAW:
                sent += value
            elif isinstance(value, bytes):
                received += [(message.t, byte) for byte in value]
        return None

    def _value(self, value: object, kind: type[Read]) -> Read:
        try:
            return msgspec.convert(value, kind)
        except msgspec.ValidationError as error:
            raise Strayed(f"{self._where} cannot be read: {error}") from error


def _hex(data: bytes) -> str:
    more = f" and {len(data) - _SHOWN} bytes more" if len(data) > _SHOWN else ""
    return (spaced(data[:_SHOWN]) or "nothing") + more
