"""The waiting policy of a run: how long it waits for answers, and how much of that was in vain."""

from __future__ import annotations

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.operations import Procedure, Received, listen
from bilprov.conformance.oracle.profile import Profile
from bilprov.conformance.oracle.timers import Timers

_PAUSE = 4 * MS  # the longest inside a frame
_NEVER = 5  # answers missing in succession, until `patience` becomes as short as `usual`


class GaveUp(Exception):
    """The device makes the rest of the run pointless; the message says why, in one sentence."""


class Waiting:
    """How long a run waits for answers, by its timers and by what the device has shown so far.

    `truncation_timeout` is the grammar's (ms), used until the device's is measured, `shortest` the
    shortest that a device may have (ms).
    `answer_pending` is true while an answer that was due may still come; `timeouts` is the time
    (ns) spent waiting for truncation time-outs.
    """

    def __init__(
        self, timers: Timers, profile: Profile, truncation_timeout: float, shortest: float
    ) -> None:
        self._timers = timers
        self._profile = profile
        self._usual_timeout = int(truncation_timeout * MS)
        self._shortest = int(shortest * MS)
        self._never_came = 0
        self._wasted = 0
        self.answer_pending = False
        self.timeouts = 0

    def answers(self, count: int, patience: int | None = None) -> Procedure[Received]:
        """Listen for `count` due answers, for `patience` ns (default: `self.patience`).

        When not all came, `answer_pending` says that they may still come.
        """
        patience = self.patience if patience is None else patience
        heard = yield from listen(count, patience)
        if len(heard.answers) < count:
            self.answer_pending = True
            self.in_vain(patience)
        return heard

    def all_answers(self, count: int, patience: int = 0) -> Procedure[Received]:
        """Listen for `count` answers, for each at most `patience` ns (0: `usual`)."""
        got: tuple[tuple[int, int], ...] = ()
        while True:
            heard = yield from listen(count - len(got), patience or self.usual)
            got += heard.answers
            if not heard.answers or len(got) >= count:
                return Received(got, heard.now)

    @property
    def usual(self) -> int:
        """How long (ns) an answer usually takes at most: the deadline, more for a slow device."""
        slow = min(2 * self._profile.slowest, self._timers.longest)
        return max(self._timers.deadline, slow)

    @property
    def timeout(self) -> int:
        """The truncation time-out (ns): the measured one, until then the grammar's."""
        return self._profile.truncation_timeout or self._usual_timeout

    @property
    def pause(self) -> int:
        """How long (ns) a pause inside a frame lasts that a device must not take for its end."""
        return min(self.timeout // 8, _PAUSE)

    @property
    def finest(self) -> int:
        """The shortest time-out (ns) that this line lets judge.

        It may tear two bytes apart by its unsteadiness, and a time-out was measured wrongly by as
        much.
        """
        return 2 * self._profile.unsteadiness + self.pause

    @property
    def coarse(self) -> bool:
        """Whether the line may make the device time out inside a frame that was sent at once."""
        return self.finest > (self._profile.truncation_timeout or self._shortest)

    @property
    def idle(self) -> int:
        """The silence (ns) after which a device that discards what follows a fault listens."""
        return max(self.timeout, self._profile.flushes_for or 0) + self._timers.settle

    @property
    def silence(self) -> int:
        """How long (ns) nothing is sent after a truncated frame: a bit more than its time-out.

        An unsteady line may bring the bytes around it closer together.
        """
        more = max(self.timeout // 4, 2 * self._profile.unsteadiness)
        return self.timeout + more + self._timers.settle

    def left_alone(self, heard: Received, sent: int, watched: int = 0) -> Procedure[Received]:
        """Wait for the rest of the silence after a truncated frame that had gone at `sent` (ns).

        Of its time-out `watched` ns were a silence of their own. Returns what was `heard`, and what
        came after it.
        """
        self.timeouts += max(0, self.timeout - watched) if heard.answers else 0
        if heard.now - sent < self.timeout // 2:
            # Answered at its header: bytes sent now would still be taken for its data.
            more = yield from listen(None, sent + self.silence - heard.now)
            heard = Received(heard.answers + more.answers, more.now)
        return heard

    @property
    def patience(self) -> int:
        """How long (ns) to wait for a due answer: the longest time allowed.

        After several missing answers, none of which came late, only as long as `usual`.
        """
        return self._timers.longest if self._never_came < _NEVER else self.usual

    def answered(self) -> None:
        """Note that an answer came: none is pending, and the device does answer."""
        self.answer_pending, self._never_came = False, 0

    def waited_for_pending(self, *, came: bool) -> None:
        """Note that the wait for a pending answer is over, and whether any answer `came`."""
        self.answer_pending = False
        self._never_came = 0 if came else self._never_came + 1

    def in_vain(self, time: int) -> None:
        """Add to the time (ns) spent waiting in vain, which `waiting_budget` limits."""
        self._wasted += time

    def require_budget(self) -> None:
        """Raise GaveUp when the time spent waiting in vain exceeds `waiting_budget`."""
        budget = self._timers.waiting_budget
        if budget is not None and self._wasted > budget:
            raise GaveUp(f"{self._wasted / 1e9:.0f} s went into waiting for what did not come")
