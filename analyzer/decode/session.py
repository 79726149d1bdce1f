"""Chunks and line events in, decoded records out: the one way in which bytes become records.

Sniffing, replaying and decoding all go through here, so a replayed capture shows what the live run
showed. No port, no clock: what comes out depends on the events and their times alone. Before each
event everything that fell due up to its time happens, in order of the times at which it was due.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from analyzer.decode import anomalies as oddities
from analyzer.decode.decoder import LOSSES, Decoder
from analyzer.decode.pairing import MILLISECOND
from analyzer.decode.records import Record
from analyzer.decode.resync import Hunt
from captures.schemas import Chunk, Direction, Line
from spec.framing import Framed
from spec.protocol import Protocol

SKEW = 20 * MILLISECOND
"""How far two taps through USB may stamp an answer before its instruction."""

BOTH: frozenset[Direction] = frozenset({"host", "device"})


class Session:
    """Decodes one recording from its first event to its last.

    `timeout` (ns) is the longest pause inside a host frame, None for the protocol's own. `heard`
    are the directions that are listened to: with one alone nothing is paired. `skew` (ns) is how
    far an answer may be stamped before its instruction; 0 where both come through one clock.
    `attached` tells that listening began at time 0 in the midst of whatever was going on: the first
    host byte need not be a header, unless the host was silent for the time-out before it.

    While it is not known where frames begin (then, and after a loss) what comes is held, until it
    is known, the host pauses for the time-out, or four of the longest frames were held.
    """

    def __init__(
        self,
        protocol: Protocol,
        *,
        timeout: int | None = None,
        heard: frozenset[Direction] = BOTH,
        skew: int = SKEW,
        attached: bool = False,
    ) -> None:
        if timeout is None:
            timeout = round(protocol.timing.truncation_timeout * MILLISECOND)
        self._protocol = protocol
        self._timeout = timeout
        self._skew = skew
        self._decoder = Decoder(protocol, timeout=timeout, paired=heard >= BOTH, skew=skew)
        # Since when it is not known where frames begin, while the host is silent; else None.
        self._adrift: int | None = 0 if attached else None
        self._spoken = False  # whether the device has spoken since then
        self._hunt: Hunt | None = None
        self._time = 0

    @property
    def deadline(self) -> int | None:
        """When (ns) something falls due even if no event comes, None if nothing does."""
        return self._hunt.deadline if self._hunt else self._decoder.deadline

    def feed(self, event: Chunk | Line) -> list[Record]:
        """What an event decides. One that is older than the last counts as coming with it."""
        if event.t < self._time:
            event = msgspec.structs.replace(event, t=self._time)
        out = list(self._until(event.t))
        self._time = event.t
        return out + list(self._event(event))

    def advance(self, now: int) -> list[Record]:
        """What falls due until `now` (ns), if no event before `now` is still to come."""
        return list(self._until(now))

    def finish(self, t: int | None = None) -> list[Record]:
        """The recording ends, at `t` (ns) or with its last event: what was waiting comes out.

        A frame that is not complete is reported as cut short, an answer that was held as
        unsolicited. Whether an instruction would still have been answered is not known.
        """
        now = self._time if t is None else t
        out = self.advance(now) + list(self._give_up_hunt()) + self.advance(now)
        return out + list(self._decoder.finish(self._time))

    def _until(self, now: int) -> Iterator[Record]:
        """Everything that falls due until `now`; the host's silence ends a hunt."""
        if self._hunt:
            if now < self._hunt.deadline:
                return
            self._hunt.silence()
            yield from self._end_hunt(self._hunt)
        yield from self._decoder.until(now)

    def _event(self, event: Chunk | Line) -> Iterator[Record]:
        """What an event decides, when all that fell due before has happened."""
        if isinstance(event, Line) and event.event in LOSSES:
            yield from self._give_up_hunt()
            yield from self._decoder.until(event.t)
            yield from self._decoder.line(event)
            if event.tap != "device":
                self._adrift, self._spoken = event.t, False
        elif isinstance(event, Chunk) and event.direction == "host":
            yield from self._host(event.data, event.t)
        elif self._hunt:
            self._hunt.other(event)
            if self._hunt.over:
                yield from self._end_hunt(self._hunt)
        else:
            self._spoken = True
            yield from self._decoded(event)

    def _host(self, data: bytes, now: int) -> Iterator[Record]:
        """Host bytes: to the hunt one by one, and as soon as it is over to the decoder."""
        if self._adrift is not None:
            self._hunt = self._new_hunt(self._adrift, now)
            self._adrift = None
        at = 0
        while self._hunt and at < len(data):
            self._hunt.host(data[at], now)
            at += 1
            if self._hunt.over:
                yield from self._end_hunt(self._hunt)
        if at < len(data):
            yield from self._decoder.host(data[at:], now)

    def _new_hunt(self, since: int, now: int) -> Hunt | None:
        """A hunt that begins with the next byte; none where silence shows that it is a header."""
        if now - since >= self._timeout:
            return None
        return Hunt(
            self._protocol,
            timeout=self._timeout,
            skew=self._skew,
            since=since,
            answered=self._spoken,
        )

    def _give_up_hunt(self) -> Iterator[Record]:
        """Nothing more will come that could tell where frames begin."""
        if self._hunt:
            self._hunt.give_up()
            yield from self._end_hunt(self._hunt)

    def _end_hunt(self, hunt: Hunt) -> Iterator[Record]:
        """What was held happens now, each at its own time."""
        self._hunt = None
        for event in hunt.settled():
            if isinstance(event, Framed):
                yield from self._decoder.until(event.known)
                yield self._decoder.garbage(event, oddities.UNCLEAR)
            else:
                yield from self._decoder.until(event.t)
                yield from self._decoded(event)

    def _decoded(self, event: Chunk | Line) -> Iterator[Record]:
        """What an event means where it is known where frames begin."""
        if isinstance(event, Line):
            yield from self._decoder.line(event)
        elif event.direction == "host":
            yield from self._decoder.host(event.data, event.t)
        else:
            yield from self._decoder.device(event.data, event.t)
