"""Handing bytes on to a peer that may not read, without ever waiting for it. No clock."""

from __future__ import annotations

from collections.abc import Callable

from analyzer.transport.errors import LinkError

_BACKLOG_LIMIT = 1 << 16  # bytes
_PATIENCE = 1_000_000_000  # ns without a byte taken


class Forward:
    """Bytes on their way to a peer: at most 64 KiB wait, and 1 s for a peer that takes nothing.

    Older bytes would only confuse a program that starts to read later. `write_some` takes bytes
    without waiting and returns how many; `complaint` says what it means when it takes none.
    """

    def __init__(self, write_some: Callable[[bytes], int], complaint: str) -> None:
        self._write_some = write_some
        self._complaint = complaint
        self._backlog = bytearray()
        self._taken_at = 0  # ns: when the peer last took something, or had nothing to take
        self._stuck = False  # it took nothing for too long, and so far nothing since
        self._told = False

    @property
    def owed(self) -> bool:
        """Whether bytes wait that the peer did not take yet."""
        return bool(self._backlog)

    def push(self, data: bytes, now: int) -> str:
        """Hand on what waits and `data`, at `now` in ns; return a sentence when bytes are dropped.

        Else "". One sentence for each time that a peer falls behind, not for each byte.
        """
        if not self._backlog:
            self._taken_at = now
        self._backlog += data
        complaint = self._complaint
        count = 0
        if self._backlog:
            try:
                count = self._write_some(bytes(self._backlog))
            except LinkError as error:  # it will take nothing any more
                complaint, self._stuck = str(error), True
        if count:
            del self._backlog[:count]
            self._taken_at, self._stuck = now, False
        if not self._backlog:
            self._told = self._told and not count
            return ""
        return self._drop(now, complaint)

    def _drop(self, now: int, complaint: str) -> str:
        """Drop what is too old or too much."""
        self._stuck = self._stuck or now - self._taken_at >= _PATIENCE
        dropped = len(self._backlog) - (0 if self._stuck else _BACKLOG_LIMIT)
        if dropped <= 0:
            return ""
        del self._backlog[-dropped:]
        told, self._told = self._told, True
        return "" if told else f"{complaint}; {dropped} bytes or more were not handed on"
