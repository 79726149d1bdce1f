"""A link that replies to each operation from a recording: the same bytes, times and looks.

There is no device. The runner must request the operations that were recorded and send the same
bytes; otherwise the recording has no reply, and `Strayed` says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

from bilprov.analyzer.client.operations import (
    HELD_ANSWERS,
    OPERATION_NAMES,
    Ended,
    Listen,
    Observation,
    Observe,
    Operation,
    PowerCycle,
    Received,
    Reconnected,
    Reply,
    Send,
)
from bilprov.analyzer.files import from_json
from bilprov.captures import topics
from bilprov.captures.reader import Message
from bilprov.captures.schemas import Asked, Look
from bilprov.spec.codec import spaced

TOPICS = frozenset({topics.HOST_RAW, topics.DEVICE_RAW, topics.LOOKS, topics.ASKS})
"""The topics read: bytes, looks, and when each operation was done. Verdicts are not read."""

CUT = "the recording ends here"

_SHOWN = 16  # bytes of a frame in a sentence
Read = TypeVar("Read", Asked, Look)


class Strayed(Exception):
    """The run requests another operation than was recorded; the message is one sentence."""


@dataclass(slots=True)
class _Step:
    """One recorded operation with the bytes and the look that belong to it."""

    asked: Asked
    sent: bytes
    received: list[tuple[int, int]]
    look: Look | None


class RecordedLink:
    """A link over the messages of a recording, in their order and of `TOPICS` alone.

    `cut` tells that the recording ended before the run did; `looks` is the class of its looks.
    """

    def __init__(self, messages: Iterator[Message], looks: type[Look]) -> None:
        self.cut = False
        self._looks = looks
        self._messages = messages
        self._heard: list[tuple[int, int]] = []
        self._number = 0
        self._next = self._read()

    @property
    def left(self) -> bool:
        """Whether the recording holds more operations than were requested."""
        return self._next is not None

    def interrupted(self) -> bool | str:
        """Whether the run was interrupted before its next operation; why, if the kit failed."""
        if self._next is None or self._next.asked.ask != OPERATION_NAMES[type(None)]:
            return False
        asked = self._take(self._next).asked
        return str(asked.ended) if asked.error else True

    def do(self, operation: Operation) -> Reply:
        """Reply as it was recorded.

        Raises Ended where the operation could not be done, or the recording ends; Strayed where
        another operation was recorded.
        """
        step = self._next
        if step is None:
            self.cut = True
            raise Ended(CUT, error=False, line_works=False)
        self._check(operation, step)
        asked = self._take(step).asked
        if asked.ended is not None and asked.lost is not None:
            self._heard.clear()
            raise Reconnected(asked.ended, asked.lost, asked.t)
        if asked.ended is not None:
            works = bool(asked.line_works)
            raise Ended(asked.ended, error=bool(asked.error), line_works=works)
        match operation:
            case Listen():
                heard, self._heard = self._heard, []
                return Received(tuple(heard[:HELD_ANSWERS]), asked.t)
            case Observe():
                assert step.look is not None
                assert asked.begun is not None
                return Observation(asked.begun, asked.t, step.look)
            case PowerCycle():
                self._heard = []
        return asked.t

    def _check(self, operation: Operation, step: _Step) -> None:
        name, recorded = OPERATION_NAMES[type(operation)], step.asked
        wanted = operation.data if isinstance(operation, Send) else b""
        if recorded.ask != name:
            raise Strayed(f"{self._where} is {recorded.ask!r}, the kit now asks for {name!r}")
        if step.sent != wanted and (recorded.ended is None or step.sent):
            raise Strayed(f"{self._where} sends {_hex(step.sent)}, the kit now {_hex(wanted)}")
        seen = step.look is not None and recorded.begun is not None
        if isinstance(operation, Observe) and recorded.ended is None and not seen:
            raise Strayed(f"{self._where} is an observation, but nothing was observed")

    @property
    def _where(self) -> str:
        return f"step {self._number} of the recording"

    def _take(self, step: _Step) -> _Step:
        """Finish a step: keep the bytes received during it, and read the next one."""
        self._heard += step.received
        self._next = self._read()
        return step

    def _read(self) -> _Step | None:
        """The next operation with the messages before it, None where the recording ends."""
        sent, received, look = bytearray(), list[tuple[int, int]](), None
        self._number += 1
        for message in self._messages:
            data = message.data
            if message.topic == topics.LOOKS:
                look = self._value(data, self._looks)
            elif message.topic == topics.ASKS:
                return _Step(self._value(data, Asked), bytes(sent), received, look)
            elif message.topic == topics.HOST_RAW:
                sent += data
            else:
                received += [(message.t, byte) for byte in data]
        return None

    def _value(self, data: bytes, kind: type[Read]) -> Read:
        try:
            return from_json(data, kind)
        except ValueError as error:
            raise Strayed(f"{self._where} cannot be read: {error}") from error


def _hex(data: bytes) -> str:
    more = f" and {len(data) - _SHOWN} bytes more" if len(data) > _SHOWN else ""
    return (spaced(data[:_SHOWN]) or "nothing") + more
