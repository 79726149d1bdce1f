"""What ordinary driving showed of a device: values only."""

from __future__ import annotations

import msgspec

from analyzer.monitor.coverage import Covered


class Violation(msgspec.Struct, frozen=True):
    """Something that a conforming device never does: when (ns), which clause and reading, why.

    `kind` is that of the fault (`disagreeing`, `unused code`, `unsolicited`, `unanswered`) or
    `moving after a fault`; `instruction` the sequence of the instruction that it is about.
    """

    t: int
    kind: str
    clause: str
    reading: str
    reason: str
    instruction: int | None


class Findings(msgspec.Struct, frozen=True):
    """What ordinary driving showed.

    `judged` counts instructions whose answer was judged, `looks` the looks at a robot that a fault
    had stopped. `not_judged` counts by reason, `violations` by kind, `readings` by reading what is
    legal although the kit reads the document otherwise. `listed` are the first violations.
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
