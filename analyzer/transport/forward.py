"""Forwards bytes to a peer without ever waiting for it, even if it does not read. Uses no clock."""

from __future__ import annotations

from collections.abc import Callable

from bilprov.analyzer.transport.errors import LinkError

_BACKLOG_LIMIT = 1 << 16  # bytes
_PATIENCE = 1_000_000_000  # ns without a byte taken


class Forward:
    """A bounded queue of bytes for a peer: at most 64 KiB, and 1 s for a peer that takes nothing.

    What exceeds these limits is dropped, since old bytes would only confuse a program that starts
    to read later. `write_some` writes without waiting and returns the number of bytes taken;
    `complaint` says in words what it means when it takes none.
    """

    def __init__(self, write_some: Callable[[bytes], int], complaint: str) -> None:
        self._write_some = write_some
        self._complaint = complaint
        self._backlog = bytearray()
        self._taken_at = 0  # ns: when the peer last took bytes, or none were waiting
        self._stuck = False  # the peer took nothing for too long, and nothing since then
        self._told = False

    @property
    def owed(self) -> bool:
        """Whether bytes wait that the peer has not taken yet."""
        return bool(self._backlog)

    def push(self, data: bytes, now: int) -> str:
        """Forward the waiting bytes and `data` at `now` (ns); return a sentence if some are lost.

        Otherwise return "". There is one sentence each time a peer falls behind, not one per drop.
        """
        if not self._backlog:
            self._taken_at = now
        self._backlog += data
        complaint = self._complaint
        count = 0
        if self._backlog:
            try:
                count = self._write_some(bytes(self._backlog))
            except LinkError as error:  # the peer will take nothing any more
                complaint, self._stuck = str(error), True
        if count:
            del self._backlog[:count]
            self._taken_at, self._stuck = now, False
        if not self._backlog:
            self._told = self._told and not count
            return ""
        return self._drop(now, complaint)

    def _drop(self, now: int, complaint: str) -> str:
        """Drop the bytes that are over the limits; return the sentence about it, or ""."""
        self._stuck = self._stuck or now - self._taken_at >= _PATIENCE
        dropped = len(self._backlog) - (0 if self._stuck else _BACKLOG_LIMIT)
        if dropped <= 0:
            return ""
        del self._backlog[-dropped:]
        told, self._told = self._told, True
        return "" if told else f"{complaint}; {dropped} bytes or more were not handed on"
