"""Notices when a program opens a pty. At a port that raises DTR, which resets an Arduino."""

from __future__ import annotations

import contextlib
import ctypes
import os

from bilprov.captures.closing import Closing

_IN_OPEN = 0x20  # of Linux's inotify: a file was opened
_EVENTS = 1 << 12  # bytes of events in one read()


class Openings(Closing):
    """The openings of a path from now on.

    One of its `descriptors` is readable once there is one. There is none on a system without
    inotify, or where this user watches too much already: then no opening is noticed.
    """

    def __init__(self, path: str) -> None:
        self.descriptors: list[int] = []
        libc = ctypes.CDLL(None)
        found = libc.inotify_init1(os.O_NONBLOCK) if hasattr(libc, "inotify_init1") else -1
        if found >= 0:
            self.descriptors = [found]
            libc.inotify_add_watch(found, path.encode(), _IN_OPEN)

    def taken(self) -> bool:
        """Return whether the path was opened since this was last asked."""
        found = False
        for descriptor in self.descriptors:
            with contextlib.suppress(BlockingIOError):
                while os.read(descriptor, _EVENTS):
                    found = True
        return found

    def close(self) -> None:
        """Watch no longer; further calls do nothing."""
        while self.descriptors:
            os.close(self.descriptors.pop())
