"""Checks the open parts (link, options and profile) of a report that is read from a file.

A later kit may write any further keys into them; the keys that this kit reads must have their type.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

Seconds = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Milliseconds = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)]
_Count = Annotated[int, msgspec.Meta(ge=0, le=1_000_000)]


class _Link(msgspec.Struct):
    kind: str
    line: str | None = None
    probe: str | None = None
    fault: str | None = None


class _Options(msgspec.Struct):
    only: list[str] = []
    level: str = "standard"
    strict: bool = False
    soak: _Count = 0
    allow: list[str] = []
    budget: Seconds | None = None
    shard: tuple[_Count, _Count] | None = None

    def __post_init__(self) -> None:
        if self.shard and not 1 <= self.shard[0] <= self.shard[1]:
            raise ValueError(f"shard {list(self.shard)} is none, it can be [I, N], I from 1 to N")


class _Profile(msgspec.Struct):
    truncation_timeout_ms: Milliseconds | None = None
    latency_median_ms: Milliseconds | None = None
    latency_max_ms: Milliseconds | None = None
    readings: dict[str, Any] = {}


class _Parts(msgspec.Struct):
    link: _Link
    options: _Options
    profile: _Profile


def require_readable(data: bytes) -> None:
    """Check the types of what is read of the open parts of a report's JSON.

    Raises msgspec's DecodeError, which names the key, and RecursionError.
    """
    msgspec.json.decode(data, type=_Parts)


def planned(clause: str, told: str | None) -> str:
    """A result's `planned`, from `clause` and `planned_clause` (None in an old file) of a file."""
    return told if told is not None and told != clause else ""
