"""The wall clock, as a capture can hold it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

EARLIEST: Final = 0
"""The first ns of 1970; a capture holds nothing before it."""
LATEST: Final = 9_214_646_400_000_000_000
"""The first ns of 2262, the last year that begins before 64 bits of ns end."""


def wall_clock(clock: Callable[[], int] = time.time_ns) -> int:
    """The time in ns of `clock`, which is EARLIEST or LATEST where it is set to beyond these."""
    try:
        return max(EARLIEST, clock())
    except OverflowError:  # Python gives no later time in ns
        return LATEST
