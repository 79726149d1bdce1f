"""Cuts a stream of bytes into frames. No port, no clock: times are given as integers in ns.

Every byte comes out in exactly one record, in order: a complete frame, a frame that the time-out
truncated, or garbage (bytes that are known to belong to no frame).
"""

from __future__ import annotations

from itertools import groupby
from typing import Literal, NamedTuple

from bilprov.spec.layout import Layout
from bilprov.spec.protocol import Protocol

Kind = Literal["instruction", "truncated", "garbage"]


class Framed(NamedTuple):
    """One record: its kind, the times of its first and last byte (ns), and its bytes.

    `known` is when it was known to be over: `end` for a complete frame, the deadline for one that
    the time-out truncated.
    """

    kind: Kind
    start: int
    end: int
    known: int
    data: bytes


class Framer:
    """Cuts the bytes of one direction into frames.

    `timeout` (ns) is the longest pause inside a frame (R-truncation-timeout), None for no limit.
    Bytes that cannot begin a frame are garbage; so are those before a right frame that begins
    within one whose check is wrong. A frame whose end nothing tells ends with the time-out.
    """

    def __init__(self, protocol: Protocol, timeout: int | None) -> None:
        self._protocol = protocol
        self._layout = protocol.layout
        self._lengths = protocol.lengths  # by header byte, where that tells how long a frame is
        self._timeout = timeout
        self._held = bytearray()
        self._times: list[int] = []  # of each held byte
        self._end = 0  # when the last byte came
        self._garbage = bytearray()
        self._garbage_span = 0, 0

    @property
    def settled(self) -> bool:
        """Whether no garbage is held, so that what is held is all there is to go on from."""
        return not self._garbage

    @property
    def held(self) -> bytes:
        """The bytes of the frame that is not complete yet."""
        return bytes(self._held)

    @property
    def missing(self) -> int:
        """How many bytes the current frame still needs; 1 if not known, 0 between frames."""
        if not self._held:
            return 0
        return 1 + self._lengths[self._held[0]] - len(self._held) if self._lengths else 1

    @property
    def deadline(self) -> int | None:
        """When (ns) the time-out ends what is held; None if nothing is."""
        if self._timeout is None or not (self._held or self._garbage):
            return None
        return self._end + self._timeout

    @property
    def span(self) -> tuple[int, int]:
        """The times (ns) of the first and the last byte of the frame that is not complete yet."""
        return (self._times[0], self._end) if self._times else (0, 0)

    @property
    def reads(self) -> list[tuple[int, bytes]]:
        """What is held of a frame that is not complete: bytes, and when they came (ns)."""
        times = [*self._times[:-1], self._end]
        places = groupby(range(len(self._held)), key=times.__getitem__)
        return [(t, bytes(self._held[place] for place in group)) for t, group in places]

    def advance(self, now: int) -> list[Framed]:
        """Let time pass until `now` (ns); return what the time-out ends."""
        deadline = self.deadline
        if deadline is None or now < deadline:
            return []
        return self._take_all(deadline, "truncated")

    def feed(self, data: bytes, now: int) -> list[Framed]:
        """Take bytes that came at `now` (ns); return the records that are over by then."""
        records = self.advance(now)
        self._held += data
        self._times += [now] * len(data)
        self._end = now if data else self._end
        records += self._cut(now)
        return records

    def resume(self, data: bytes, start: int, end: int) -> None:
        """Go on from a frame that is not complete: its bytes, and their first and last time (ns).

        Raises ValueError for bytes that are not the beginning of one frame.
        """
        size = self._size(data, 0) if data else None
        if size is not None and size <= len(data):
            raise ValueError(f"{len(data)} bytes are not a frame that is still open")
        self._held[:] = data
        self._times = [start] * max(1, len(data) - 1) + [end]
        del self._times[len(data) :]
        self._end = end if data else self._end

    def drop(self, now: int, kind: Kind = "garbage") -> list[Framed]:
        """End what is held: bytes were lost, or the stream ends; a frame begins with the next."""
        return self._take_all(now, kind) if self._held or self._garbage else []

    def _cut(self, known: int) -> list[Framed]:
        """Take the frames that are complete."""
        records: list[Framed] = []
        held, at = bytes(self._held), 0
        while at < len(held):
            size = self._size(held, at)
            if size is None or size > len(held) - at:
                break
            frame = held[at : at + max(size, 0)]
            check = self._layout.of_frame(frame).check
            damaged = frame and check and not check.holds(frame)
            if size < 0 or (damaged and self._right_frame(held, at + 1, at + size) is not None):
                self._skip(at, 1)
                at += 1
                continue
            if self._garbage:
                records += self._flush(known)
            times, end = self._times, at + size
            records.append(Framed("instruction", times[at], times[end - 1], known, frame))
            at = end
        self._forget(at)
        return records

    def _size(self, held: bytes, at: int) -> int | None:
        """The size of the frame that begins at a place; mostly its first bytes tell it."""
        if self._lengths:
            return 1 + self._lengths[held[at]]
        size = frame_size(self._protocol, held[at : at + _AHEAD])
        if size is None and len(held) - at > _AHEAD:
            size = frame_size(self._protocol, held[at:])
        return size

    def _take_all(self, known: int, kind: Kind) -> list[Framed]:
        """Take all that is held: the right frames within, and the rest as one frame of a kind."""
        records: list[Framed] = []
        while self._held:
            begun = self._right_frame(bytes(self._held), 1, len(self._held))
            if begun is not None:
                self._skip(0, begun)
                self._forget(begun)
                records += self._cut(known)
                continue
            records += self._flush(known)
            whole: Kind = "instruction" if kind == "truncated" and self._is_unknown() else kind
            records.append(Framed(whole, *self.span, known, bytes(self._held)))
            self._forget(len(self._held))
        records += self._flush(known)
        return records

    def _is_unknown(self) -> bool:
        """Whether what is held has an ID whose length nothing tells."""
        layout = self._layout
        if layout.part("length") or len(self._held) < layout.head + layout.tail:
            return False
        return layout.value("id", bytes(self._held)) not in self._protocol.by_id

    def _right_frame(self, held: bytes, first: int, after: int) -> int | None:
        """The first place in `first`..`after` at which a frame begins whose check is right."""
        if self._layout.check is None:
            return None
        for at in range(first, after):
            size = self._size(held, at)
            if size is None or not 0 < size <= len(held) - at:
                continue
            frame = held[at : at + size]
            check = self._layout.of_frame(frame).check
            if check and check.holds(frame) and not self._layout.wrong_constant(frame):
                return at
        return None

    def _skip(self, at: int, count: int) -> None:
        """Make some held bytes garbage, which follows what is garbage already."""
        start = self._garbage_span[0] if self._garbage else self._times[at]
        self._garbage_span = start, self._times[at + count - 1]
        self._garbage += self._held[at : at + count]

    def _forget(self, count: int) -> None:
        """Hold the first bytes no longer."""
        del self._held[:count], self._times[:count]

    def _flush(self, known: int) -> list[Framed]:
        if not self._garbage:
            return []
        record = Framed("garbage", *self._garbage_span, known, bytes(self._garbage))
        self._garbage.clear()
        return [record]


def frame_size(protocol: Protocol, held: bytes) -> int | None:
    """How many bytes the request has that begins so; None: not known yet, -1: it can be none."""
    layout = protocol.layout
    if len(held) < layout.head:
        return None if layout.begins(held) else -1
    identity = layout.value("id", held)
    spec = protocol.by_id.get(identity) if identity is not None else None
    if spec is None and layout.part("length") is None:
        return _unknown_size(layout, held) if layout.begins(held) else -1
    return layout.size(held, spec)


def is_open(protocol: Protocol, held: bytes) -> bool:
    """Whether bytes are none, or the beginning of a request that is not complete."""
    size = frame_size(protocol, held) if held else None
    return size is None or size > len(held)


def _unknown_size(layout: Layout, held: bytes) -> int | None:
    """The size of a frame with an unused ID and no length: as far as its check and end are right.

    A short check is right by chance too often to tell that.
    """
    least = layout.head + layout.tail
    if layout.check and layout.check.part.size > 1:
        right = layout.check.right_sizes(held[:_MOST_UNKNOWN], least)
        return next((n for n in right if not layout.wrong_constant(held[:n])), None)
    marked = any(part.offset < 0 and not part.width for part in layout.constants)
    if marked and len(held) >= least and not layout.wrong_constant(held[:least]):
        return least
    return None


_AHEAD = 1024  # bytes that tell the size of nearly every frame
_MOST_UNKNOWN = 512  # bytes within which the end of a frame with an unused ID is looked for
