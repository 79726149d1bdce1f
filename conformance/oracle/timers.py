"""The timers of a run (how long it waits) and its observability (what its probe can see)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec

from bilprov.captures.schemas import MS


@dataclass(frozen=True, slots=True)
class Timers:
    """How long the runner waits, in ns.

    `deadline` is when an answer is due: a later one is slow. `longest` is when a missing answer is
    given up: a later one fails. `silence` is kept after an answer before the next step, `hold`
    while a thorough case watches the stop. `grace` is how much later than the answer a stop may be
    seen although it was in time (the link's own jitter), `settle` the time for what may still be
    under way, `boot` that for the first answer, `idle` how long a moving robot is sent nothing,
    `never` when a truncated frame counts as never answered. `waiting_budget` bounds the time spent
    waiting for missing answers in all, `run_budget` that of all cases on a slow device; None means
    no bound.
    """

    deadline: int = 100 * MS
    longest: int = 1000 * MS
    silence: int = 20 * MS
    hold: int = 250 * MS
    grace: int = 0
    settle: int = MS
    boot: int = 10_000 * MS
    never: int = 2500 * MS
    idle: int = 1200 * MS
    waiting_budget: int | None = None
    run_budget: int | None = None

    def due_within(self, deadline: int) -> Timers:
        """These timers with another deadline (ns) for an answer; `longest` is at least as long."""
        return replace(self, deadline=deadline, longest=max(self.longest, deadline))


class Observability(msgspec.Struct, frozen=True, rename={"available": "open", "costly": "sparse"}):
    """What a probe can see: nothing (`available` false), everything, or a few looks (`costly`).

    `why` says why something is not observable. Recordings keep the fields under older names.
    """

    available: bool
    costly: bool = False
    why: str = "no probe; see --probe"
