"""Sets which signals a process that a test starts ignores, however the tests were started."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def ignoring(*ignored: signal.Signals) -> Iterator[None]:
    """A process that is started inside ignores these of SIGINT, SIGHUP and SIGTERM and no others.

    A background job of a shell ignores SIGINT and what nohup starts ignores SIGHUP, and both hand
    that on to what they start.
    """
    before = {}
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        handler = signal.SIG_IGN if number in ignored else signal.SIG_DFL
        if (signal.getsignal(number) is signal.SIG_IGN) is not (number in ignored):
            before[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for known, was in before.items():
            signal.signal(known, was)
