"""The time limit of a run: ends one that takes much longer than was announced, and says why."""

from __future__ import annotations

from bilprov.analyzer.client.operations import Ended, Operation, PowerCycle, Reply

_TIMES = 3  # what was announced
_AT_LEAST = 60_000_000_000  # ns more than that, so that no short run ends for a busy moment


class TimeLimit:
    """Follows a run's operations, and ends it once it takes three times what was announced.

    `announced` is in s; None is no limit. Switching the power is not counted.
    """

    def __init__(self, announced: float | None) -> None:
        self._announced = None if announced is None else int(announced * 1e9)
        self._begun: int | None = None
        self._now = 0

    def announce(self, more: float) -> None:
        """Take note that the run was said to take so long (s) from now on."""
        if self._announced is not None:
            self._announced = max(self._announced, self._taken + int(more * 1e9))

    def leave_out(self, time: int) -> None:
        """Do not count this time (ns), which is over."""
        self._begun = (self._begun or 0) + time
        self._now += time

    def did(self, operation: Operation, reply: Reply) -> None:
        """Take note of an operation that was done."""
        before, self._now = self._now, reply if isinstance(reply, int) else reply.now
        if self._begun is None:
            self._begun = self._now
        elif isinstance(operation, PowerCycle):
            self._begun += self._now - before

    def require(self) -> None:
        """Raise Ended where the run has taken too long."""
        announced, taken = self._announced, self._taken
        if announced is None or taken <= max(_TIMES * announced, announced + _AT_LEAST):
            return
        raise Ended(
            f"about {announced / 1e9:.0f} s were announced and {taken / 1e9:.0f} s have passed; "
            "--patient continues however long it takes",
            error=False,
            line_works=True,
            by="time",
        )

    @property
    def _taken(self) -> int:
        """How long (ns) the run has taken so far."""
        return self._now - (self._begun or 0)
