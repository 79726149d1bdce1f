"""Tells requests and answers apart that share one wire, as on RS-485 and servo buses.

It uses no port and no clock: times are integers in ns.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from operator import itemgetter

from bilprov.captures.schemas import MS, Chunk, Direction
from bilprov.spec.codec import FRAMING_FAULTS, Judgement, judge
from bilprov.spec.framing import frame_size
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import GIVES_UP, read_reply, reply_size


def separated(protocol: Protocol, chunks: Iterable[Chunk]) -> list[Chunk]:
    """What was heard of one wire, each part with who sent it."""
    wire = HalfDuplex(protocol, round(protocol.timing.truncation_timeout * MS))
    known = [part for chunk in chunks for part in wire.feed(chunk.data, chunk.t)]
    return known + wire.rest()


class HalfDuplex:
    """Gives the bytes of one wire a direction each; `timeout` (ns) is the longest pause in a frame.

    After a request that is answered, the next frame that can be its answer is the answer, within
    the time that an answer may take. If it can be a request too, it is the answer as long as the
    host can be waiting for one. Bytes that are neither belong to the side whose turn it is, as far
    as the next right request or the next pause.
    """

    def __init__(self, protocol: Protocol, timeout: int) -> None:
        self._protocol = protocol
        self._timeout = timeout
        self._longest = round(protocol.timing.answer_longest * MS)
        self._gives_up = round(protocol.timing.answer_deadline * MS) // GIVES_UP
        self._held = bytearray()
        self._times: list[int] = []
        self._asked: Judgement | None = None  # the request whose answer is due
        self._asked_end = 0

    @property
    def since(self) -> int | None:
        """When (ns) the first byte came that has no direction yet, None if there is none."""
        return self._times[0] if self._times else None

    def advance(self, now: int) -> list[Chunk]:
        """Let time pass until `now` (ns); return the bytes whose direction a pause tells."""
        over = bool(self._times) and now >= self._times[-1] + self._timeout
        return self.rest() if over else []

    def feed(self, data: bytes, now: int) -> list[Chunk]:
        """Take bytes that came at `now` (ns); return those whose direction is known by then."""
        chunks = self.advance(now)
        self._held += data
        self._times += [now] * len(data)
        return chunks + self._known(at_end=False)

    def rest(self) -> list[Chunk]:
        """Return all bytes that are held: no more follow without a pause."""
        return self._known(at_end=True)

    def _known(self, *, at_end: bool) -> list[Chunk]:
        chunks: list[Chunk] = []
        while self._held:
            held = bytes(self._held)
            if self._asked and self._times[0] - self._asked_end > self._longest:
                self._asked = None
            answer = self._answer(held)
            size = answer or self._request(held)
            if not size:
                known = (
                    reply_size(self._protocol, held, self._asked),
                    frame_size(self._protocol, held),
                )
                if not at_end and any(end is not None and end > len(held) for end in known):
                    break  # an answer or a request goes on
                later = (at for at in range(1, len(held)) if self._request(held[at:]))
                size = next(later, len(held) if at_end else 0)
                answer = size if self._asked else 0
            if not size:
                break
            chunks += self._taken("device" if answer else "host", size)
        return chunks

    def _answer(self, held: bytes) -> int:
        """The size of the right answer with which the bytes begin, 0 if they begin with none."""
        size = reply_size(self._protocol, held, self._asked) or 0
        if not 0 < size <= len(held) or read_reply(self._protocol, held[:size], self._asked).reason:
            return 0
        if self._asked and self._times[0] - self._asked_end < self._gives_up:
            return size
        request = frame_size(self._protocol, held)
        if request is None or request > len(held):
            return 0  # it may become a request
        return 0 if request > 0 and judge(self._protocol, held[:request]).valid else size

    def _request(self, held: bytes) -> int:
        """The size of the right request with which the bytes begin, 0 if they begin with none."""
        size = frame_size(self._protocol, held) or 0
        if not 0 < size <= len(held):
            return 0
        judgement = judge(self._protocol, held[:size])
        check = self._protocol.layout.of(judgement.id).check
        right = judgement.outcome not in FRAMING_FAULTS if check else judgement.valid
        return size if right else 0

    def _taken(self, side: Direction, size: int) -> list[Chunk]:
        """Take the first bytes, as what a side has sent; a request may wait for an answer."""
        data, times = bytes(self._held[:size]), self._times[:size]
        del self._held[:size], self._times[:size]
        self._asked = None
        if side == "host" and frame_size(self._protocol, data) == size:
            judgement = judge(self._protocol, data)
            self._asked = judgement if judgement.answer_due else None
            self._asked_end = times[-1]
        groups = groupby(zip(times, data, strict=True), key=itemgetter(0))
        return [Chunk(t, side, bytes(byte for _, byte in group)) for t, group in groups]
