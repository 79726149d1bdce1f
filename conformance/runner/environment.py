"""What a run rests on besides grammar and options: the same run can be made again from it."""

from __future__ import annotations

from typing import Any

import msgspec

from conformance.oracle.judge import MS
from conformance.oracle.timers import Eyes, Limits
from spec.protocol import Protocol

# How much later than an answer a stop may be seen on a real line although it was in time: link and
# probe are two lines, and a busy machine is late itself.
_GRACE = 20 * MS
_WASTE = 90_000 * MS
_WHOLE = 300_000 * MS


class Circumstances(msgspec.Struct, frozen=True):
    """Where and how a run takes place.

    `virtual` is true for a device object in virtual time, false for a port. `eyes` says what can be
    seen, `power` whether the robot can be switched off and on. `device` and `link` only say in the
    report what it was.
    """

    virtual: bool
    eyes: Eyes
    power: bool
    device: str
    link: dict[str, Any]

    def limits(self, grammar: Protocol) -> Limits:
        """How long is waited, before the options have a say."""
        # What is later than allowed must still be heard.
        longest = int(grammar.timing.answer_longest * MS)
        if self.virtual:
            return Limits(longest=longest)
        return Limits(longest=longest, grace=_GRACE, settle=2 * MS, waste=_WASTE, whole=_WHOLE)
