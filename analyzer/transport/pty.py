"""A pseudo terminal (pty) in raw mode, which a host program opens as its port, and its openings.

At a port that raises DTR an opening resets an Arduino.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import tty

from bilprov.analyzer.transport.errors import LinkError
from bilprov.captures.closing import Closing

_READ_LIMIT = 1 << 16  # bytes in one read(), so that a flood cannot hold the caller


class PtyPair(Closing):
    """Both ends of a pty: `master` is our descriptor (non-blocking), `name` the path for others.

    The pair keeps the slave open, so that the master never gets EIO when the last program closes
    the path. Unread bytes wait in the kernel (at least 4 KiB), as in a driver's buffer.
    """

    def __init__(self, master: int, slave: int) -> None:
        self.master = master
        self.name = os.ttyname(slave)
        self._descriptors = [master, slave]

    def read(self) -> bytes:
        """Return what the program at the path has written, at most 64 KiB, without waiting."""
        taken = bytearray()
        with contextlib.suppress(BlockingIOError):
            while len(taken) < _READ_LIMIT:
                taken += os.read(self.master, _READ_LIMIT)
        return bytes(taken)

    def write_some(self, data: bytes) -> int:
        """Write without waiting and return how many bytes were taken: 0 when the pty is full."""
        try:
            return os.write(self.master, data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Close both ends; a program that has the path open sees an unplugged port."""
        while self._descriptors:
            with contextlib.suppress(OSError):
                os.close(self._descriptors.pop())


def open_pty() -> PtyPair:
    """Return a new pty in raw mode: 8 bits, no echo, no signals, no flow control.

    A new pty is in cooked mode, where 0x03 would come back as "^C" and 0x11 would be XON.
    Raises LinkError if the system has no pty left.
    """
    try:
        master, slave = os.openpty()
    except OSError as error:
        raise LinkError(
            f"this machine gives no pty: {error.strerror}; close a program that holds some"
        ) from error
    tty.setraw(slave)
    os.set_blocking(master, False)
    return PtyPair(master, slave)


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
