"""Families of faults: what their rows have in common, and parts of their names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bilprov.conformance.dut.fault import Fault, React
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion

# Cases other than single frames: sequences, delivery, soak, consistency of readings, power-on.
SEQUENCE = ("sequence/*",)
PIPELINED = ("pipelined/*",)
SPLIT = ("split/*",)
MANY_FRAMES = ("combined/*", "pipelined/soak/*")
READING = ("reading/*",)
POWER_ON = ("power-on/*",)

EVERYTHING = ("*",)

# The cases of each outcome in which the stop and the state are observed.
WATCHED = {
    Outcome.UNKNOWN_ID: ("unused-id/*", "recovery/unused-id/*"),
    Outcome.BAD_DATA: ("bad-data/*", "recovery/bad-data/*"),
    Outcome.TOO_MANY: ("wrong-length/*", "recovery/too-many/*"),
    Outcome.TOO_FEW: ("wrong-length/*", "recovery/too-few/*"),
}
WATCHED_CUT = ("truncated/*", "recovery/truncated/*")
# Cases that hold the stop and send valid instructions after it: for faults that show later.
FOLLOWED = ("unused-id/*", "bad-data/*", "wrong-length/*", "truncated/*")
WATCHED_FAULTS = (*FOLLOWED, "recovery/*")

# The cases of each outcome in which its answer shows.
CASES = {
    **WATCHED,
    Outcome.UNKNOWN_ID: (*WATCHED[Outcome.UNKNOWN_ID], "link/unused-id"),
    Outcome.TOO_FEW: (*WATCHED[Outcome.TOO_FEW], "link/too-few"),
}
# The time-out is measured on a robot that moves, in the first kind of motion that it has.
TIMED = ("timing/truncation-timeout",)
CUT = (*WATCHED_CUT, *TIMED)
WHOLE_FAULTS = tuple(dict.fromkeys(glob for globs in CASES.values() for glob in globs))
ALL_FAULTY = (*WHOLE_FAULTS, *CUT)


@dataclass(frozen=True, slots=True)
class Family:
    """A family of faults, and what a row of it breaks and which cases catch it by default.

    `clauses` are the names of fields of `spec.fields.Clauses`, separated by blanks. Calling the
    family makes one fault from its row: name, description, and reaction to a frame. A row that
    differs from its family says so by `clauses` or `caught_by`; other fields of `Fault` (an exit
    code, other hooks) are given by name.
    """

    name: str
    clauses: str
    caught_by: tuple[str, ...] = SEQUENCE

    def __call__(
        self,
        name: str,
        doc: str,
        react: React | None = None,
        *,
        clauses: str = "",
        caught_by: tuple[str, ...] | None = None,
        **others: Any,
    ) -> Fault:
        """Return the fault of this row; the name is written in lower case."""
        return Fault(
            name.lower(),
            self.name,
            doc,
            self.caught_by if caught_by is None else caught_by,
            react=react,
            clauses=tuple((clauses or self.clauses).split()),
            **others,
        )


def slug(outcome: Outcome) -> str:
    """Return an outcome as it is written in a fault's name: `too-few`."""
    return outcome.name.lower().replace("_", "-")


def words(motion: Motion) -> str:
    """Return a motion as it is written in a fault's name: `rotate-left`."""
    return motion.value.replace("_", "-")
