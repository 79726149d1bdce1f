"""The results of judging a device from ordinary traffic: values only."""

from __future__ import annotations

import msgspec

from bilprov.analyzer.monitor.coverage import Covered


class Violation(msgspec.Struct, frozen=True):
    """Something a conforming device never does: its time `t` (ns), clause, reading and reason.

    `kind` is that of the anomaly (`disagreeing`, `unused code`, `unsolicited`, `unanswered`) or
    `moving after a fault`; `instruction` is the sequence of the instruction that it is about.
    """

    t: int
    kind: str
    clause: str
    reading: str
    reason: str
    instruction: int | None


class Findings(msgspec.Struct, frozen=True):
    """The results of judging one session.

    `judged` counts the instructions whose answer was judged, and `looks` the probe readings of a
    robot that a faulty instruction had stopped. `not_judged` counts by reason. `violations` counts
    by kind; the first ones are `listed`. `readings` counts, by reading, the answers that are legal
    although the kit reads the document otherwise.
    """

    instructions: int
    judged: int
    looks: int
    not_judged: dict[str, int]
    violations: dict[str, int]
    readings: dict[str, int]
    coverage: tuple[Covered, ...]
    listed: tuple[Violation, ...]

    @property
    def exit(self) -> int:
        """1 if there was a violation, else 0."""
        return 1 if self.violations else 0
