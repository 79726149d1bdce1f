"""Cuts what a device sends into answers of more than one byte: by the requests that wait for one.

It uses no port and no clock: times are integers in ns.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from msgspec.structs import replace

from bilprov.analyzer.decode.pairing import Waiting
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import Reply, read_reply, reply_size

_LOOKED_AT = 64  # requests at most for a pause among them; hosts send few without an answer


class Heard(NamedTuple):
    """An answer, the times (ns) of its first and last byte, and how many requests it passes over.

    Those were sent before the one that it answers, and are not answered.
    """

    reply: Reply
    start: int
    end: int
    passed: int = 0


class ReplyFramer:
    """Holds the bytes of answers that are not complete; `timeout` (ns) is the longest pause."""

    def __init__(self, protocol: Protocol, timeout: int) -> None:
        self._protocol = protocol
        self._timeout = timeout
        self._held = bytearray()
        self._times: list[int] = []

    @property
    def held(self) -> bool:
        """Whether bytes are held."""
        return bool(self._held)

    @property
    def deadline(self) -> int | None:
        """When (ns) what is held is over; None if nothing is held."""
        return self._times[-1] + self._timeout if self._times else None

    def feed(self, data: bytes, now: int) -> None:
        """Take bytes that came at `now` (ns)."""
        self._held += data
        self._times += [now] * len(data)

    def forget(self) -> None:
        """Drop what is held."""
        self._held.clear()
        self._times.clear()

    def delay(self, pause: int) -> None:
        """Let what is held have come so much (ns) later."""
        self._times = [t + pause for t in self._times]

    def take(self, waiting: Iterable[Waiting], gives_up: int) -> Heard | None:
        """Take the next answer to the requests that wait, the oldest first; None if none is whole.

        A right answer to a later one passes over those before it. Where it is right for several it
        is that to the first after the last pause of `gives_up` (ns): a host that pauses so long
        without an answer, and then sends another request, does not wait for the first any more.
        """
        held = bytes(self._held)
        right: Heard | None = None
        damaged: Heard | None = None
        paused, before = False, None
        for passed, one in enumerate(waiting):
            paused = paused or (before is not None and one.end - before >= gives_up)
            before = one.end
            if right and not paused:
                if passed < _LOOKED_AT:
                    continue
                break
            size = reply_size(self._protocol, held, one.judgement)
            if size is None or size > len(held):
                break
            if size < 0:
                continue
            reply = read_reply(self._protocol, held[:size], one.judgement)
            heard = Heard(reply, self._times[0], self._times[size - 1], passed)
            if not reply.reason:
                right, paused = heard, False
            damaged = damaged or heard
        best = right or damaged
        return best and self._taken(best)

    def take_unasked(self) -> Heard | None:
        """Take the next answer where no request is heard; None if it is not whole, or not known."""
        size = reply_size(self._protocol, bytes(self._held), None) if self._held else None
        if size is None or not 0 < size <= len(self._held):
            return None
        reply = read_reply(self._protocol, bytes(self._held[:size]), None)
        return self._taken(Heard(reply, self._times[0], self._times[size - 1]))

    def take_rest(self, *, alone: bool = False) -> Heard | None:
        """Take all that is held as one answer, mostly a damaged one; None if nothing is held.

        With `alone` no requests are heard.
        """
        if not self._held:
            return None
        reply = read_reply(self._protocol, bytes(self._held), None, alone=alone)
        if reply.reason:  # a right one ends by itself
            reply = replace(reply, open_end=True)
        return self._taken(Heard(reply, self._times[0], self._times[-1]))

    def _taken(self, heard: Heard) -> Heard:
        size = len(heard.reply.frame)
        del self._held[:size], self._times[:size]
        return heard
