"""Places in a recording as people type them: a row's number, a time since the start, a clock."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime, timedelta, tzinfo
from datetime import time as clock

_NUMBER = re.compile(r"(?P<number>\d+(?:\.\d*)?) ?(?P<unit>us|ms|s)?")
_UNITS = {"us": 1e3, "ms": 1e6, "s": 1e9}
REFUSAL = "give the number of a row like 120, or a time like 12.5s, 300ms or 14:03:20"


def row_of(text: str, start_wall: int, zone: tzinfo | None, row_at: Callable[[int], int]) -> int:
    """The row (from 0) that a text stands for. Raises ValueError if it is no place.

    `row_at` gives the row at a time (ns since the start), which is `start_wall` (ns since 1970). A
    time of day is one in this zone (None: the zone here), after the start.
    """
    match = _NUMBER.fullmatch(text)
    if match and not match["unit"] and "." not in text:
        return max(0, int(text) - 1)
    if match:
        return row_at(round(float(match["number"]) * _UNITS[match["unit"] or "s"]))
    try:
        at = clock.fromisoformat(text)
    except ValueError:
        raise ValueError(REFUSAL) from None
    start = datetime.fromtimestamp(start_wall / 1e9, zone)
    moment = datetime.combine(start, at, zone)
    if moment < start:
        moment += timedelta(days=1)
    return row_at(round((moment - start).total_seconds() * 1e9))
