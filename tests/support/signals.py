"""Sets which signals a process that a test starts ignores; without that it ignores none."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def ignoring(*ignored: signal.Signals) -> Iterator[None]:
    """A process that is started inside ignores these, as nohup and a shell's `&` have it."""
    before = {number: signal.signal(number, signal.SIG_IGN) for number in ignored}
    try:
        yield
    finally:
        for number, was in before.items():
            signal.signal(number, was)


@contextmanager
def handled(number: int, handler: Any) -> Iterator[None]:
    """A signal has this handler inside."""
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)
