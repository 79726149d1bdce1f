"""What a probe of a device's choices is, and what it shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from conformance.dut.operations import Script
from conformance.runner.run import Run


@dataclass(frozen=True, slots=True)
class Shown:
    """What one probe showed: (point, word) pairs, "" where nothing could be told.

    `fault` says what no reading allows, "" for nothing, `coarse` why the line is too slow to tell.
    What was seen and heard is kept for the report and does not count when two of them are compared.
    """

    words: tuple[tuple[str, str], ...]
    expected: str
    actual: str = field(compare=False)
    fault: str = ""
    heard: tuple[tuple[int, int], ...] = field(default=(), compare=False)
    coarse: str = ""


@dataclass(frozen=True, slots=True)
class Probe:
    """One probe: what it is about, and the script that makes it on a homed line.

    `sees` if it needs looks, `safety` if it is about the stop, `long` if it is not made twice
    without need, `option` the option of `--allow` without which it is not made.
    """

    name: str
    points: tuple[str, ...]
    requirement: str
    make: Callable[[Run], Script[Shown]]
    stimulus: bytes = b""
    sees: bool = False
    safety: bool = False
    long: bool = False
    option: str = ""
