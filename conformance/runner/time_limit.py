"""The time limit of a run: ends one that takes much longer than was announced, and says why."""

from __future__ import annotations

from bilprov.analyzer.client.operations import (
    Ended,
    Listen,
    Observation,
    Operation,
    PowerCycle,
    Received,
    Reply,
)

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
        self._looks: list[int] = []
        self._answers = self._silences = self._late = 0

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
        now = reply if isinstance(reply, int) else reply.now
        if self._begun is None:
            self._begun = self._now = now
            return
        took, self._now = now - self._now, now
        if isinstance(operation, PowerCycle):
            self._begun += took
        elif isinstance(reply, Observation):
            look = now - reply.asked
            self._looks.append(look)
            self._late += took - look
        elif isinstance(operation, Listen) and isinstance(reply, Received):
            if operation.count is None:
                self._silences += min(took, operation.patience)
                self._late += max(0, took - operation.patience)
            else:
                self._answers += took

    def require(self) -> None:
        """Raise Ended, with the parts of the time that was taken, where it was too long."""
        announced = self._announced
        if announced is None:
            return
        if self._taken > max(_TIMES * announced, announced + _AT_LEAST):
            count = len(self._looks)
            each = f" ({sum(self._looks) / count / 1e6:.0f} ms each)" if count else ""
            parts = (
                (self._answers, "waiting for answers"),
                (sum(self._looks), f"observations{each}"),
                (self._silences, "silences"),
                (self._late, "delays of this computer"),
            )
            told = ", ".join(f"{_seconds(time)} {what}" for time, what in parts)
            raise Ended(
                f"about {_seconds(announced)} were announced and {_seconds(self._taken)} have "
                f"passed ({told}); --patient continues however long it takes",
                error=False,
                line_works=True,
                by="time",
            )

    @property
    def _taken(self) -> int:
        """How long (ns) the run has taken so far."""
        return self._now - (self._begun or 0)


def _seconds(time: int) -> str:
    return f"{time / 1e9:.0f} s"
