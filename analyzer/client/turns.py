"""A lock that threads get in the order in which they asked for it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import RLock, get_ident


class Turns:
    """A lock that its thread may take again, as a signal handler in it does.

    A thread that uses a robot without a pause would keep all others from a common lock, also the
    one that wants to stop it.
    """

    def __init__(self) -> None:
        self._lock = RLock()
        self._next = RLock()  # held by the one thread that is next
        self._owner: int | None = None
        self._depth = 0

    @contextmanager
    def taken(self, patience: float = -1) -> Iterator[bool]:
        """Take the lock until the block ends; gives whether it was got in `patience` s."""
        got = self._acquire(patience)
        try:
            yield got
        finally:
            if got:
                self._release()

    def _acquire(self, patience: float) -> bool:
        again = self._owner == get_ident()
        if not again and not self._next.acquire(timeout=patience):
            return False
        try:
            got = self._lock.acquire(timeout=patience)
        finally:
            if not again:
                self._next.release()
        if got:
            self._owner = get_ident()
            self._depth += 1
        return got

    def _release(self) -> None:
        self._depth -= 1
        if not self._depth:
            self._owner = None
        self._lock.release()
