"""Resynchronisation: buffers traffic until frame boundaries are found, then releases it.

Released events keep their own times, so the session decodes the same records as if the boundaries
had been known from the start. It uses no port and no clock.
"""

from __future__ import annotations

from collections.abc import Iterator

from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.spec.framing import Framed
from bilprov.spec.protocol import Protocol
from bilprov.spec.synchronise import ANSWER, IDLE, SILENCE, Synchroniser, traffic

BOUNDARY = 0.75
"""Probability that the first byte heard is a header.

When listening began at a random byte of normal traffic, it was a header in 76 % of the trials. When
listening begins at a random time the share is higher, since a line is idle between frames.
"""

# A place is taken as the first frame boundary if it is one with this probability.
_SURE = 0.99
_LIKELIER = 0.5  # the same when no more evidence can come; a host idle that long is mostly idle
_OTHERS = 1 << 14  # device bytes and line events that are buffered, which no line brings meanwhile
_HELD = 4  # longest frames that are buffered; then the likelier alternative is taken


class Resync:
    """Buffers events from the first host byte until frame boundaries are found.

    `timeout` (ns) is the longest pause within a frame; `skew` (ns) is how long an adapter may
    delay bytes. The host has been silent since `since` (ns); `answered` is true if the device sent
    a byte in that time.
    """

    def __init__(
        self, protocol: Protocol, *, timeout: int, skew: int, since: int, answered: bool
    ) -> None:
        self._timeout = timeout
        # A pause longer than any adapter causes, after which a device may cut a frame short
        # (R-truncation-timeout).
        self._idle = max(skew, round(protocol.timing.truncation_shortest * MS))
        self._most = _HELD * protocol.longest_frame
        self._synchroniser = Synchroniser(traffic(protocol), BOUNDARY)
        self._events: list[Chunk | Line] = []
        self._others = 0
        self._last = since
        self._sure = _SURE
        self._answered = False
        if answered:
            self._anchor_once()

    @property
    def deadline(self) -> int:
        """When (ns) the host has been silent for so long that no frame can be open."""
        return self._last + self._timeout

    @property
    def over(self) -> bool:
        """Whether resynchronisation has ended: boundaries are found, or the buffer is full."""
        held = self._synchroniser.held
        return self._synchroniser.locked or held >= self._most or self._others >= _OTHERS

    def host(self, byte: int, now: int) -> None:
        """Buffer the host's next byte, which came at `now` (ns)."""
        if now - self._last >= self._idle:
            self._synchroniser.anchor(IDLE)
        self._answered = False
        self._last = now
        self._synchroniser.byte(byte)
        self._events.append(Chunk(now, "host", bytes([byte])))

    def other(self, event: Chunk | Line) -> None:
        """Buffer device bytes, or a line event that is not a loss."""
        if isinstance(event, Chunk):
            self._anchor_once()
        self._events.append(event)
        self._others += len(event.data) if isinstance(event, Chunk) else 1
        if self._others >= _OTHERS:
            self.give_up()

    def silence(self) -> None:
        """End resynchronisation at `deadline`: no frame can be open, a boundary is here."""
        self._synchroniser.anchor(SILENCE)
        self.give_up()

    def give_up(self) -> None:
        """End resynchronisation without more evidence: accept the likelier boundary."""
        self._sure = _LIKELIER

    def settled(self) -> Iterator[Chunk | Line | Framed]:
        """Yield the buffered events in order; host bytes before the first frame are one garbage."""
        first = self._synchroniser.first_frame(self._sure)
        before: list[Chunk] = []
        for event in self._events:
            if isinstance(event, Line) or event.direction == "device" or len(before) == first:
                yield event
                continue
            before.append(event)
            if len(before) == first:
                start, end = before[0].t, before[-1].t
                yield Framed("garbage", start, end, end, b"".join(one.data for one in before))

    def _anchor_once(self) -> None:
        """Use an answer as evidence of a boundary; a run without host bytes between counts once."""
        if not self._answered:
            self._answered = True
            self._synchroniser.anchor(ANSWER)
