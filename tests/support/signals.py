"""Sets how this process handles a signal, which a process that it starts inherits."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def handled(handler: Any, *numbers: int) -> Iterator[None]:
    """Signals have this handler inside; ignored ones are so for what is started there, too."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, was in before.items():
            signal.signal(number, was)
