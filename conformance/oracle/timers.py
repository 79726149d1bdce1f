"""The timers of a run: how long it waits, by default and in an environment."""

from __future__ import annotations

from dataclasses import dataclass, replace

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.link import Environment
from bilprov.spec.protocol import Protocol

# How much later than an answer a stop may be seen on a real line although it was in time: link and
# probe are two lines, and a busy machine is late itself.
_GRACE = 20 * MS
_WAITING_BUDGET = 90_000 * MS
_RUN_BUDGET = 300_000 * MS


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


def timers_of(environment: Environment, protocol: Protocol) -> Timers:
    """The default timers of a run in this environment, to which the options are then applied."""
    # Answers later than allowed must still be received, to be judged.
    longest = int(protocol.timing.answer_longest * MS)
    if environment.virtual:
        return Timers(longest=longest)
    return Timers(
        longest=longest,
        grace=_GRACE,
        settle=2 * MS,
        waiting_budget=_WAITING_BUDGET,
        run_budget=_RUN_BUDGET,
    )
