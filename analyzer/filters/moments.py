"""Times of day and dates as a filter has them, in the time zone of whoever asks. Needs no numpy."""

from __future__ import annotations

import re
import time
from functools import lru_cache
from typing import NamedTuple

SECOND = 1_000_000_000  # ns
DAY = 86_400 * SECOND  # ns
STEP = 900 * SECOND
"""Ns between the moments at which a time zone may change its offset: all do at a quarter."""

_WRITTEN = re.compile(
    r"(?:(?P<day>\d{4}-\d\d-\d\d)[T ]?)?"
    r"(?:(?P<hour>\d\d?):(?P<minute>\d\d)(?::(?P<second>\d\d)(?:\.(?P<part>\d{1,9}))?)?)?"
    r"(?P<zone>Z|[+-]\d\d:?\d\d)?",
    re.ASCII,
)


class Instant(NamedTuple):
    """A moment in ns: since midnight if it is `daily`, or else since 1970."""

    daily: bool
    ns: int


def instant(text: str) -> Instant | None:
    """The moment that is written as `14:03:20`, `2026-11-22 14:03:20` or `2026-11-22`.

    Minutes are enough, a fraction of a second has up to nine digits. A date is local, unless `Z` or
    an offset like `+02:00` stands behind it. None for what is no moment.
    """
    match = _WRITTEN.fullmatch(text)
    if match is None or not (match["day"] or match["hour"]):
        return None
    hour, minute, second = (int(match[name] or 0) for name in ("hour", "minute", "second"))
    rest = int((match["part"] or "").ljust(9, "0"))
    if hour > 23 or minute > 59 or second > 59:
        return None
    if match["day"] is None:
        ns = (hour * 3600 + minute * 60 + second) * SECOND + rest
        return None if match["zone"] else Instant(True, ns)
    from datetime import datetime

    clock = f"{hour:02d}:{minute:02d}:{second:02d}"
    try:
        since = datetime.fromisoformat(f"{match['day']}T{clock}{match['zone'] or ''}").timestamp()
    except (ValueError, OverflowError, OSError):
        return None
    return Instant(False, int(since) * SECOND + rest)


@lru_cache(maxsize=4096)
def offset(step: int) -> int:
    """How far (ns) local time is ahead of UTC from a moment on: a number of STEPs since 1970."""
    return time.localtime(step * STEP // SECOND).tm_gmtoff * SECOND
