"""Sorts the messages of foreign writers by time, holding back a bounded number of them."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import Generic, TypeVar

from bilprov.captures.storage.limits import WINDOW_BYTES, WINDOW_MESSAGES

Item = TypeVar("Item")


class TimeWindow(Generic[Item]):
    """A sorting window that holds back up to 4,096 messages or 16 MiB and yields them by time.

    Messages with equal times keep their order. `late` counts messages that came out after a later
    one, because the window was too small.
    """

    def __init__(self) -> None:
        self.late = 0
        self._held: list[tuple[int, int, int, Item]] = []
        self._bytes = 0
        self._count = 0
        self._latest = 0

    def push(self, time: int, size: int, item: Item) -> Iterator[Item]:
        """Add a message of `size` bytes at `time` (ns); yield those that exceed the window."""
        heapq.heappush(self._held, (time, self._count, size, item))
        self._count += 1
        self._bytes += size
        while len(self._held) > WINDOW_MESSAGES or self._bytes > WINDOW_BYTES:
            yield self._pop()

    def rest(self) -> Iterator[Item]:
        """Yield all messages that are still held."""
        while self._held:
            yield self._pop()

    def _pop(self) -> Item:
        time, _, size, item = heapq.heappop(self._held)
        self._bytes -= size
        if time < self._latest:
            self.late += 1
        self._latest = max(self._latest, time)
        return item
