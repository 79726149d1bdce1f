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


LONGEST: Final = (1 << 62) - 1
"""The most ns before and after a capture's start; a time beyond it is taken for this.

That is 146 years. The sum and the difference of two such times fit into 64 bits.
"""


def since(start: int, log_time: int) -> int:
    """The time of a message in ns since the capture's start."""
    return min(max(log_time - start, -LONGEST), LONGEST)


def stated_number(text: str | None) -> int | None:
    """The number of ns, or of a part, that a text in a capture states; None if it states none."""
    if text is None or len(text) > 20 or not (text.isascii() and text.isdigit()):
        return None
    stated = int(text)
    return stated if stated < 1 << 64 else None
