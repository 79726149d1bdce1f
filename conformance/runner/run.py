"""State of one conformance run: configuration, device profile, the open test case, the results.

A case stays open until the line has been homed after it, because a late answer counts against it;
then it is final and reported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from bilprov.captures.schemas import MS
from bilprov.conformance.cases.adaptation import on_the_wire
from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.dut.operations import Procedure, Received, listen
from bilprov.conformance.oracle.choices import FLUSH_POINTS, POINTS
from bilprov.conformance.oracle.judge import NOT_OBSERVABLE, matching
from bilprov.conformance.oracle.profile import Profile
from bilprov.conformance.oracle.state_model import Model
from bilprov.conformance.oracle.timers import Observability, Timers
from bilprov.conformance.oracle.verdicts import AnswerByte, Axis, CaseResult, Verdict, worst
from bilprov.conformance.oracle.wording import answer_words
from bilprov.conformance.runner.stray_answers import StrayAnswers
from bilprov.spec.codec import spaced
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol


class GaveUp(Exception):
    """The device makes the rest of the run pointless; the message says why, in one sentence."""


_NEVER = 5  # answers missing in succession, until `patience` becomes as short as `usual`


@dataclass
class _Open:
    case: Case | SequenceCase
    axes: dict[str, Axis]
    heard: list[tuple[int, int]]
    sent: int


class RunState:
    """State of one run. `begin` and `report` are called when a case begins and when it is final.

    `truncation_timeout` is in ns, None while it is not known. `power` says whether the robot can be
    switched off and on, `profile` holds what was measured of the device. `expected_state` is the
    state the robot must have now, `before` the one before the case's stimulus; `stray_answers`
    collects answers that belong to no case.
    """

    def __init__(
        self,
        protocol: Protocol,
        timers: Timers,
        observability: Observability,
        *,
        begin: Callable[[str], None],
        report: Callable[[CaseResult], None],
        truncation_timeout: int | None = None,
        power: bool = False,
        profile: Profile | None = None,
    ) -> None:
        self.protocol = protocol
        self.timers = timers
        self.observability = observability
        self.profile = profile or Profile()
        if truncation_timeout is not None:
            self.profile.truncation_timeout = truncation_timeout
        self.model = Model(protocol, self.profile.choices)
        self.before = self.expected_state = self.model.found()
        self.power = power
        self.begin = begin
        self.results: list[CaseResult] = []
        self.moves: set[Motion] | None = None
        self.stray_answers = StrayAnswers(protocol, self.end)
        self._report = report
        self._open: _Open | None = None
        self._wasted = 0
        self.answer_pending = False
        self._never_came = 0
        self.trying: list[CaseResult] | None = None
        self.suspect: CaseResult | None = None
        self.flaky = self.reproduced = self.shrunk = self.missed_stops = 0
        self.floods = 0
        self.timeouts = 0  # ns spent waiting for truncation time-outs
        self._nudges = 0

    # -- the case that is open --------------------------------------------------------------------

    def open(
        self, case: Case | SequenceCase, axes: dict[str, Axis], heard: Received, sent: int
    ) -> None:
        """Make this the open case; `sent` is the time (ns) when its stimulus had been sent."""
        self._open = _Open(case, dict(axes), list(heard.answers), sent)

    def close(self) -> None:
        """Make the open case, if there is one, final."""
        if self._open is not None:
            self._keep_to_choice(self._open)
            done, self._open = self._open, None
            self.end(done.case, done.axes, done.heard, done.sent)

    def _keep_to_choice(self, done: _Open) -> None:
        """Fail a case in which the device contradicts its earlier choice of an open point."""
        case = done.case
        if (
            isinstance(case, SequenceCase)
            or not case.point
            or done.axes["answer"].verdict >= Verdict.INCONCLUSIVE
        ):
            return
        codes = tuple(code for _, code in done.heard)
        choice = matching(case.accepted, codes)
        if choice is None:
            return
        word = choice.word or POINTS[case.point].default
        contradiction = self.profile.choices.record(case.point, word, case.id)
        if contradiction:
            words, reading = answer_words(self.protocol, codes), POINTS[case.point].reading
            self.worsen("answer", Verdict.FAIL, words, contradiction, reading)

    def end(
        self,
        case: Case | SequenceCase,
        axes: dict[str, Axis],
        heard: Iterable[tuple[int, int]] = (),
        sent: int = 0,
    ) -> None:
        """Make a case's result; publish it, or keep it for the attempt that is under way."""
        result = CaseResult(
            id=case.id,
            clause=case.clause,
            requirement=case.requirement,
            verdict=worst(axis.verdict for axis in axes.values()),
            axes=axes,
            reading=next((a.reading for a in axes.values() if a.reading), case.reading),
            sent=tuple(spaced(frame) for frame in case.sent if frame),
            received=tuple(AnswerByte(f"{code:02x}", t - sent) for t, code in heard),
        )
        if self.trying is None:
            self.publish(result)
        else:
            self.trying.append(result)

    def publish(self, result: CaseResult) -> None:
        """Record a final result and report it."""
        self.results.append(result)
        self._report(result)

    def tried(self, ident: str) -> CaseResult:
        """End the attempt at that case: return its result, publish the other results it made."""
        results, self.trying = self.trying or [], None
        for result in results:
            if result.id != ident:
                self.publish(result)
        return [result for result in results if result.id == ident][-1]

    def drop_tries(self) -> None:
        """End an unfinished retry: publish the first attempt's result, as it is."""
        self.trying = None
        if self.suspect is not None:
            suspect, self.suspect, self._open = self.suspect, None, None
            self.publish(suspect)

    @property
    def axes(self) -> dict[str, Axis]:
        """The axes of the open case."""
        assert self._open is not None
        return self._open.axes

    def hear(self, more: Received) -> tuple[Received, int]:
        """Add answers to the open case; return all it got, and when its stimulus was sent (ns)."""
        assert self._open is not None
        self._open.heard += more.answers
        if more.answers:
            self.answer_pending, self._never_came = False, 0
        return Received(tuple(self._open.heard), more.now), self._open.sent

    def worsen(
        self, name: str, verdict: Verdict, actual: str, reason: str, reading: str = ""
    ) -> None:
        """Worsen an axis of the open case, never improve it; on a tie the first reason stays."""
        axis = self.axes[name]
        if verdict > axis.verdict:
            reading = reading or axis.reading
            self.axes[name] = Axis(verdict, axis.expected, actual, reason, reading)

    def cut_short(self, verdict: Verdict, reason: str) -> None:
        """Give the open case, judged only in part, this verdict unless it failed."""
        if worst(axis.verdict for axis in self.axes.values()) < Verdict.FAIL:
            self.worsen("answer", verdict, self.axes["answer"].actual, reason)

    def attribute_to_case(
        self, late: Iterable[tuple[int, int]], reason: str, reading: str = ""
    ) -> None:
        """Count late or missing answers against the open case, or as stray where none is open.

        `late` are (time in ns, code); empty when the device stopped answering.
        """
        if self._open is not None:
            self._open.heard += late
            codes = tuple(code for _, code in self._open.heard)
            words = answer_words(self.protocol, codes)
            if reading:  # it explains every other deviation in the case
                expected = self.axes["answer"].expected
                self.axes["answer"] = Axis(Verdict.FAIL, expected, words, reason, reading)
            self.worsen("answer", Verdict.FAIL, words, reason)
            return
        if late := tuple(late):
            self.stray_answers.unexpected(late, reason)
        else:
            self.stray_answers.silent(reason)

    @property
    def in_step(self) -> bool:
        """Whether the open case got its due answers, so that the line is at a frame boundary."""
        return self._open is not None and self.axes["answer"].verdict < Verdict.INCONCLUSIVE

    @property
    def keeps_all(self) -> bool:
        """Whether this device takes each instruction completely, regardless of what preceded it.

        False for one that loses what follows a fault, answers before a frame's end, or leaves a
        truncated frame unanswered.
        """
        choices = self.profile.choices
        if "pipelining" in choices.allowed or self.profile.flushes:
            return False
        loses = any(choices.differs(point) for point in (*FLUSH_POINTS, "R-answer-point"))
        return not loses and self.profile.truncation_answered is not False

    @property
    def open_id(self) -> str:
        """The open case's id, "" where none is open."""
        return self._open.case.id if self._open else ""

    def wire(self, frame: bytes) -> bytes:
        """A valid frame adapted to the device's choices, b"" for an unknown instruction."""
        return on_the_wire(self.protocol, self.profile.choices, frame)

    # -- patience ---------------------------------------------------------------------------------

    def answers(self, count: int, patience: int | None = None) -> Procedure[Received]:
        """Listen for `count` due answers, for `patience` ns (default: `self.patience`).

        When not all came, `answer_pending` says that they may still come.
        """
        patience = self.patience if patience is None else patience
        heard = yield from listen(count, patience)
        if len(heard.answers) < count:
            self.answer_pending = True
            self.add_waiting(patience)
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
        return max(self.timers.deadline, min(2 * self.profile.slowest, self.timers.longest))

    @property
    def timeout(self) -> int:
        """The truncation time-out (ns): the measured one, until then the grammar's."""
        usual = int(self.protocol.timing.truncation_timeout * MS)
        return self.profile.truncation_timeout or usual

    @property
    def patience(self) -> int:
        """How long (ns) to wait for a due answer: the longest time allowed.

        After several missing answers, none of which came late, only as long as `usual`.
        """
        return self.timers.longest if self._never_came < _NEVER else self.usual

    def late_answer(self, heard: Received) -> None:
        """Count answers that came after the wait for a pending answer against the open case."""
        self.answer_pending = False
        came = heard.answers or (self._open is not None and self._open.heard)
        self._never_came = 0 if came else self._never_came + 1
        if heard.answers:
            self.attribute_to_case(
                heard.answers, "the answer came later than the longest time allowed"
            )

    def add_waiting(self, time: int) -> None:
        """Add to the time (ns) spent waiting in vain, which `waiting_budget` limits."""
        self._wasted += time

    def check_patience(self) -> None:
        """Raise GaveUp when the time spent waiting in vain exceeds `waiting_budget`."""
        if self.timers.waiting_budget is not None and self._wasted > self.timers.waiting_budget:
            raise GaveUp(f"{self._wasted / 1e9:.0f} s went into waiting for what did not come")

    def next_nudge(self) -> int:
        """The next value of a counter that rotates through the checks after a stop."""
        self._nudges += 1
        return self._nudges

    # -- observability ----------------------------------------------------------------------------

    def looks_at(self, case: Case) -> bool:
        """Whether this case is observed: only thorough ones where looks are costly."""
        return self.observability.available and (case.thorough or not self.observability.costly)

    @property
    def observable(self) -> bool:
        """Whether looks are available and cheap."""
        return self.observability.available and not self.observability.costly

    def not_observable(self, expected: str) -> Axis:
        """The axis of something that cannot be observed: inconclusive, never a pass."""
        why = "not seen moving before" if self.observable else self.observability.why
        reason = f"{NOT_OBSERVABLE} ({why})"
        return Axis(Verdict.INCONCLUSIVE, expected, "", reason)
