"""When a part of a recording is full and how many are kept, also as a user writes it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from decimal import Decimal
from typing import Final, NamedTuple

from bilprov.captures.text import printable

SIZES: Final[Mapping[str, int]] = {
    "kb": 10**3,
    "mb": 10**6,
    "gb": 10**9,
    "kib": 2**10,
    "mib": 2**20,
    "gib": 2**30,
}  # bytes
TIMES: Final[Mapping[str, int]] = {"s": 10**9, "min": 60 * 10**9, "h": 3600 * 10**9}  # ns
LEAST_SIZE: Final = 100_000  # bytes; what a file holds beside the traffic takes some 10,000
LEAST_TIME: Final = 10**9  # ns
MOST: Final = 10**19  # bytes or ns, some 300 years
_VALUE = re.compile(r"(\d{1,15}(?:\.\d{1,9})?) ?([a-z]+)", re.IGNORECASE | re.ASCII)


class Rotation(NamedTuple):
    """When a part of a recording is full, and how many are kept.

    It is at `size` bytes of the file or at an `age` in ns, where they are given. The newest `keep`
    parts are kept, the one that is written included; None stands for all.
    """

    size: int | None = None
    age: int | None = None
    keep: int | None = None


def rotation_at(text: str) -> Rotation:
    """The Rotation at a size or a time with its unit, like "100MB" or "1h", in any case.

    Raises ValueError, in a sentence, for anything else.
    """
    match = _VALUE.fullmatch(text)
    unit = match[2].lower() if match else ""
    amount = Decimal(match[1]) if match else Decimal(0)
    size = int(amount * SIZES.get(unit, 0))
    age = int(amount * TIMES.get(unit, 0))
    if not LEAST_SIZE <= size <= MOST and not LEAST_TIME <= age <= MOST:
        raise ValueError(
            f"{printable(text)} is neither a size of 100 kB or more (kB, MB, GB, KiB, MiB, GiB) "
            "nor a time of 1 s or more (s, min, h): write 100MB or 1h, for example"
        )
    return Rotation(size=size or None, age=age or None)
