"""Cuts a stream of bytes into frames. No port, no clock: times are given as integers in ns.

Every byte comes out in exactly one record, in order: a complete frame, a frame that the time-out
truncated, or garbage (bytes that are known to belong to no frame).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

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

    `lengths` gives for each header byte the number of data bytes it announces; `timeout` (ns) is
    the longest pause inside a frame (R-truncation-timeout), None for no limit.
    """

    def __init__(self, lengths: Sequence[int], timeout: int | None) -> None:
        self._lengths = lengths
        self._timeout = timeout
        self._held = bytearray()
        self._start = 0
        self._end = 0

    @property
    def held(self) -> bytes:
        """The bytes of the frame that is not complete yet."""
        return bytes(self._held)

    @property
    def missing(self) -> int:
        """How many bytes the current frame still needs; 0 between frames."""
        return 1 + self._lengths[self._held[0]] - len(self._held) if self._held else 0

    @property
    def deadline(self) -> int | None:
        """When (ns) the time-out truncates the current frame; None between frames."""
        if not self._held or self._timeout is None:
            return None
        return self._end + self._timeout

    def advance(self, now: int) -> list[Framed]:
        """Let time pass until `now` (ns); return the frame that the time-out truncates, if any."""
        deadline = self.deadline
        if deadline is None or now < deadline:
            return []
        return [self._take("truncated", deadline)]

    def feed(self, data: bytes, now: int) -> list[Framed]:
        """Take bytes that came at `now` (ns); return the records that are over by then."""
        records = self.advance(now)
        at = 0
        while at < len(data):
            if not self._held:
                self._start = now
            part = data[at : at + (self.missing or 1 + self._lengths[data[at]])]
            self._held += part
            self._end = now
            at += len(part)
            if not self.missing:
                records.append(self._take("instruction", now))
        return records

    def resume(self, data: bytes, start: int, end: int) -> None:
        """Go on from a frame that is not complete: its bytes, and their first and last time (ns).

        Raises ValueError for bytes that are not the beginning of one frame.
        """
        if data and len(data) > self._lengths[data[0]]:
            raise ValueError(f"{len(data)} bytes are not a frame that is still open")
        self._held[:] = data
        self._start, self._end = start, end

    @property
    def span(self) -> tuple[int, int]:
        """The times (ns) of the first and the last byte of the frame that is not complete yet."""
        return self._start, self._end

    def drop(self, now: int, kind: Kind = "garbage") -> list[Framed]:
        """End the current frame: bytes were lost, or the stream ends; the next byte is a header."""
        return [self._take(kind, now)] if self._held else []

    def _take(self, kind: Kind, known: int) -> Framed:
        record = Framed(kind, self._start, self._end, known, bytes(self._held))
        self._held.clear()
        return record
