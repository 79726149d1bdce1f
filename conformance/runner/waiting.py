"""The waiting policy of a run, its time limit, and what the delays of its line leave open."""

from __future__ import annotations

from bilprov.analyzer.client.operations import (
    Ended,
    Operation,
    PowerCycle,
    Procedure,
    Received,
    Reply,
    listen,
)
from bilprov.captures.schemas import MS
from bilprov.conformance.cases.budget import PAUSE, group
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.oracle.profile import Profile, Timers
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import FLUSH_POINTS

_SETTLED = MS  # within which a prompt line has brought what is under way
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
        return min(self.timeout // 8, PAUSE)

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
    def settle(self) -> int:
        """How long (ns) what is under way may take: less than the timer's on a prompt line."""
        if self._profile.round_trip is None:
            return self._timers.settle
        slowest = self._profile.round_trip + (self._profile.jitter or 0)
        return min(self._timers.settle, max(_SETTLED, slowest))

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

    def left_alone(
        self, heard: Received, sent: int, watched: int = 0, *, silent: bool = False
    ) -> Procedure[Received]:
        """Wait for the rest of the silence after a truncated frame that had gone at `sent` (ns).

        Of its time-out `watched` ns were a silence of their own; `silent` if no answer shows its
        end. Returns what was `heard`, and what came after it.
        """
        self.timeouts += max(0, self.timeout - watched) if heard.answers else 0
        left = sent + self.silence - heard.now
        if heard.now - sent < self.timeout // 2 or (silent and left > 0):
            # Answered at its header: bytes sent now would still be taken for its data.
            heard += yield from listen(None, left)
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


class CoarseLine:
    """Decides what of a run may be due to a line that delays bytes by different times.

    Such a line may tear a frame apart, and a good robot then rightly times out inside it: it
    answers that the frame was cut short, stops, and takes the other bytes for instructions of their
    own. Any answer that the protocol knows may come of that, none may, and any motion: it is
    inconclusive. An answer that no device gives does not come of it.

    A robot that discards what follows a fault until the line is idle takes it where the line lets
    the next byte come a little later.
    """

    def __init__(self, protocol: Protocol, waiting: Waiting, profile: Profile) -> None:
        self._codes = protocol.codes
        self._waiting = waiting
        self._profile = profile
        self._beyond: set[str] = set()

    def forbids(self, case: AnyCase) -> bool:
        """Whether a sequence was too fine for this line, and this is another of its set."""
        return isinstance(case, SequenceCase) and group(case.id) in self._beyond

    def explains(self, result: CaseResult) -> bool:
        """Whether the line may be why a case failed."""
        if result.verdict is not Verdict.FAIL or not self.coarse:
            return False
        return all(int(answer.hex, 16) in self._codes for answer in result.received)

    @property
    def coarse(self) -> bool:
        """Whether the line changes what this device hears, as far as times go."""
        return self._waiting.coarse or (
            self._loses and 2 * self._profile.unsteadiness > self._waiting.pause
        )

    @property
    def _loses(self) -> bool:
        """Whether the device discards what follows a fault."""
        profile = self._profile
        return profile.flushes or any(map(profile.choices.differs, FLUSH_POINTS))

    def judged(self, result: CaseResult) -> CaseResult:
        """The result, inconclusive where the line may be why it failed."""
        if not self.explains(result):
            return result
        self._beyond.add(group(result.id))
        return result.uncertain(f"{self.sentence}: ")

    @property
    def sentence(self) -> str:
        """What the line does, and what cannot be judged over it."""
        late, finest = self._profile.unsteadiness / MS, self._waiting.finest / MS
        behind = ", nor what is sent right behind a fault" if self._loses else ""
        return (
            f"the line delays bytes by up to {late:.0f} ms: pauses inside a frame and time-outs "
            f"below {finest:.0f} ms cannot be judged{behind}"
        )


# -- the time limit of a run, which ends one that takes much longer than was announced ------------


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
