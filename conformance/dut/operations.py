"""What the runner asks for and what it gets: it sends, listens and looks only through these values.

Times are integers in nanoseconds on the drive's own clock, virtual or real.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, TypeVar

from captures.schemas import Look

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Send:
    """Send these bytes; the reply is the time when the last one had gone."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Listen:
    """Wait until `count` answer bytes have come (None: never enough) or `patience` ns are over.

    The reply is Heard: everything that came since the last time.
    """

    count: int | None
    patience: int


@dataclass(frozen=True, slots=True)
class See:
    """Look at the robot through the probe; the reply is Seen."""


@dataclass(frozen=True, slots=True)
class PowerCycle:
    """Switch the robot off and on; the reply is the time when it is on again."""


@dataclass(frozen=True, slots=True)
class Heard:
    """Answer bytes as (time, byte), and the time when listening ended."""

    answers: tuple[tuple[int, int], ...]
    now: int

    @property
    def codes(self) -> tuple[int, ...]:
        """The bytes alone."""
        return tuple(code for _, code in self.answers)


@dataclass(frozen=True, slots=True)
class Seen:
    """A reading of the probe with the time it was asked and the time it was there."""

    asked: int
    now: int
    look: Look


Ask = Send | Listen | See | PowerCycle
Script = Generator[Ask, Any, T]


def send(data: bytes) -> Script[int]:
    """Send bytes; returns the time (ns) when the last one had gone."""
    sent = yield Send(data)
    assert isinstance(sent, int)
    return sent


def listen(count: int | None, patience: int) -> Script[Heard]:
    """Listen for `count` answers or `patience` ns."""
    heard = yield Listen(count, patience)
    assert isinstance(heard, Heard)
    return heard


def power_cycle() -> Script[int]:
    """Switch the robot off and on; returns the time (ns) when it is on again."""
    now = yield PowerCycle()
    assert isinstance(now, int)
    return now


def see() -> Script[Seen]:
    """Look through the probe."""
    seen = yield See()
    assert isinstance(seen, Seen)
    return seen
