"""What a session keeps while it does not know where frames begin. No port, no clock.

Events wait here, and go through the session once more with their own times when it is known: so
what comes out is what would have come out, had it been known from the start.
"""

from __future__ import annotations

from collections.abc import Iterator

from analyzer.decode.pairing import MILLISECOND
from captures.schemas import Chunk, Line
from spec.framing import Framed
from spec.protocol import Protocol
from spec.synchronise import ANSWER, IDLE, SILENCE, Synchroniser, traffic

BOUNDARY = 0.75
"""How likely the first byte that is heard is a header.

Attaching at a byte picked at random it was one after 76 % of the attaches in normal traffic;
attaching at a moment picked at random it is one more often, since a line rests between frames.
"""

_SURE = 0.99  # frames come out from the first place that is as sure to be a boundary
_LIKELIER = 0.5  # the same where no more can be learnt; a host that rests so long mostly rests
_HELD = 4  # longest frames; then it is decided by what is likelier


class Hunt:
    """Holds events, and weighs them, from the first host byte until it is known where frames begin.

    `timeout` (ns) is the longest pause within a frame, `skew` (ns) how long an adapter may keep
    bytes back. The host line was silent since `since` (ns); `answered` tells whether the device
    spoke meanwhile.
    """

    def __init__(
        self, protocol: Protocol, *, timeout: int, skew: int, since: int, answered: bool
    ) -> None:
        self._timeout = timeout
        # A pause that no adapter makes by itself, and for which a device may cut a frame short
        # (R-truncation-timeout).
        self._idle = max(skew, round(protocol.timing.truncation_shortest * MILLISECOND))
        self._most = _HELD * protocol.longest_frame
        self._synchroniser = Synchroniser(traffic(protocol), BOUNDARY)
        self._events: list[Chunk | Line] = []
        self._last = since
        self._sure = _SURE
        self._answered = False
        if answered:
            self._anchor_once()

    @property
    def deadline(self) -> int:
        """When (ns) the host's silence tells that no frame is under way."""
        return self._last + self._timeout

    @property
    def over(self) -> bool:
        """Whether it is known where frames begin, or as well known as it will be."""
        return self._synchroniser.locked or self._synchroniser.held >= self._most

    def host(self, byte: int, now: int) -> None:
        """The host's next byte, at `now` (ns)."""
        if now - self._last >= self._idle:
            self._synchroniser.anchor(IDLE)
        self._answered = False
        self._last = now
        self._synchroniser.byte(byte)
        self._events.append(Chunk(now, "host", bytes([byte])))

    def other(self, event: Chunk | Line) -> None:
        """A device byte or a line event after which no bytes are known to be missing."""
        if isinstance(event, Chunk):
            self._anchor_once()
        self._events.append(event)

    def silence(self) -> None:
        """The host has been silent so long that no frame is under way."""
        self._synchroniser.anchor(SILENCE)
        self.give_up()

    def give_up(self) -> None:
        """Nothing more will come that could tell: what is likelier must do."""
        self._sure = _LIKELIER

    def settled(self) -> Iterator[Chunk | Line | Framed]:
        """The events in order; in place of the bytes before the first frame, they as garbage."""
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
        """Answers that come one after the other, without host bytes between, speak as one."""
        if not self._answered:
            self._answered = True
            self._synchroniser.anchor(ANSWER)
