"""Environment of a run: what, besides grammar and options, is needed to repeat the run."""

from __future__ import annotations

from typing import Any

import msgspec

from bilprov.captures.schemas import MS
from bilprov.conformance.oracle.timers import Observability, Timers
from bilprov.spec.protocol import Protocol

# How much later than an answer a stop may be seen on a real line although it was in time: link and
# probe are two lines, and a busy machine is late itself.
_GRACE = 20 * MS
_WAITING_BUDGET = 90_000 * MS
_RUN_BUDGET = 300_000 * MS


class Environment(msgspec.Struct, frozen=True, rename={"observability": "eyes"}):
    """Where and how a run takes place.

    `virtual` is true for a device object in virtual time, false for a port. `observability` says
    what can be observed, `power` whether the robot can be switched off and on. `device` and `link`
    describe the device and the link in the report only.
    """

    virtual: bool
    observability: Observability
    power: bool
    device: str
    link: dict[str, Any]

    def timers(self, grammar: Protocol) -> Timers:
        """The default timers of this environment, to which the options are then applied."""
        # Answers later than allowed must still be received, to be judged.
        longest = int(grammar.timing.answer_longest * MS)
        if self.virtual:
            return Timers(longest=longest)
        return Timers(
            longest=longest,
            grace=_GRACE,
            settle=2 * MS,
            waiting_budget=_WAITING_BUDGET,
            run_budget=_RUN_BUDGET,
        )
