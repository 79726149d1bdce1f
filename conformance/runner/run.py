"""One run's books: limits, what can be seen, what was measured, the case still open, the results.

A case stays open until the line has been homed after it, because an answer that comes late is
charged to it; then it is final and reported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from conformance.cases.adaptation import on_the_wire
from conformance.cases.sequence import Walk
from conformance.cases.single_frames import Case
from conformance.dut.operations import Heard, Script, listen
from conformance.oracle.choices import LOSING, POINTS
from conformance.oracle.judge import MS, NOT_OBSERVABLE, answer_words, matching
from conformance.oracle.profile import Profile
from conformance.oracle.state_model import Model
from conformance.oracle.timers import Eyes, Limits
from conformance.oracle.verdicts import Axis, CaseResult, Received, Verdict, worst
from conformance.runner.stray_answers import Between
from spec.codec import spaced
from spec.motion import Motion
from spec.protocol import Protocol


class Ended(Exception):
    """The run cannot go on: what a drive throws into the script, in one sentence.

    `error` is true when the kit, the port or the probe failed, false when the user interrupted;
    `line_works` tells whether the robot can still be homed.
    """

    def __init__(self, sentence: str, *, error: bool, line_works: bool) -> None:
        super().__init__(sentence)
        self.error = error
        self.line_works = line_works


class GaveUp(Exception):
    """The device makes the rest of the run pointless: the sentence says why."""


_NEVER = 5  # answers that never came, until a missing one is no longer waited for so long


@dataclass
class _Open:
    case: Case | Walk
    axes: dict[str, Axis]
    heard: list[tuple[int, int]]
    sent: int


class Run:
    """The books of one run. `begin` and `report` are called as cases begin and become final.

    `power` says whether the robot can be switched off and on, `profile` what is known of it.
    `belief` is what it must be like now, `before` what it was before the case's stimulus;
    `between` keeps what belongs to no case.
    """

    def __init__(
        self,
        protocol: Protocol,
        limits: Limits,
        eyes: Eyes,
        *,
        begin: Callable[[str], None],
        report: Callable[[CaseResult], None],
        truncation_timeout: int | None = None,
        power: bool = False,
        profile: Profile | None = None,
    ) -> None:
        self.protocol = protocol
        self.limits = limits
        self.eyes = eyes
        self.profile = profile or Profile()
        if truncation_timeout is not None:
            self.profile.truncation_timeout = truncation_timeout
        self.model = Model(protocol, self.profile.choices)
        self.before = self.belief = self.model.found()
        self.power = power
        self.begin = begin
        self.results: list[CaseResult] = []
        self.moves: set[Motion] | None = None
        self.between = Between(protocol, self.end)
        self._report = report
        self._open: _Open | None = None
        self._wasted = 0
        self.missing = False
        self._never_came = 0
        self.trying: list[CaseResult] | None = None
        self.suspect: CaseResult | None = None
        self.flaky = self.reproduced = self.shrunk = self.missed_stops = 0
        self.floods = 0
        self.timeouts = 0  # ns that were waited for frames that are cut short
        self._nudges = 0

    # -- the case that is open --------------------------------------------------------------------

    def open(self, case: Case | Walk, axes: dict[str, Axis], heard: Heard, sent: int) -> None:
        """From now on this case is judged; `sent` is when its stimulus had gone."""
        self._open = _Open(case, dict(axes), list(heard.answers), sent)

    def close(self) -> None:
        """The case before is final."""
        if self._open is not None:
            self._keep_to_choice(self._open)
            done, self._open = self._open, None
            self.end(done.case, done.axes, done.heard, done.sent)

    def _keep_to_choice(self, done: _Open) -> None:
        """A device that has shown one choice of a point shows no other."""
        case = done.case
        if (
            isinstance(case, Walk)
            or not case.point
            or done.axes["answer"].verdict >= Verdict.INCONCLUSIVE
        ):
            return
        codes = tuple(code for _, code in done.heard)
        choice = matching(case.accepted, codes)
        if choice is None:
            return
        word = choice.word or POINTS[case.point].default
        contradiction = self.profile.choices.settle(case.point, word, case.id)
        if contradiction:
            words, reading = answer_words(self.protocol, codes), POINTS[case.point].reading
            self.worsen("answer", Verdict.FAIL, words, contradiction, reading)

    def end(
        self,
        case: Case | Walk,
        axes: dict[str, Axis],
        heard: Iterable[tuple[int, int]] = (),
        sent: int = 0,
    ) -> None:
        """A case's result."""
        result = CaseResult(
            id=case.id,
            clause=case.clause,
            requirement=case.requirement,
            verdict=worst(axis.verdict for axis in axes.values()),
            axes=axes,
            reading=next((a.reading for a in axes.values() if a.reading), case.reading),
            sent=tuple(spaced(frame) for frame in case.sent if frame),
            received=tuple(Received(f"{code:02x}", t - sent) for t, code in heard),
        )
        if self.trying is None:
            self.publish(result)
        else:
            self.trying.append(result)

    def publish(self, result: CaseResult) -> None:
        """A result is final."""
        self.results.append(result)
        self._report(result)

    def tried(self, ident: str) -> CaseResult:
        """The result of a try of that case, which is over; what else came of it is final."""
        results, self.trying = self.trying or [], None
        for result in results:
            if result.id != ident:
                self.publish(result)
        return [result for result in results if result.id == ident][-1]

    def drop_tries(self) -> None:
        """The run ends while a case is tried again: it failed once, and that is not confirmed."""
        self.trying = None
        if self.suspect is not None:
            suspect, self.suspect, self._open = self.suspect, None, None
            self.publish(suspect)

    @property
    def axes(self) -> dict[str, Axis]:
        """The axes of the open case."""
        assert self._open is not None
        return self._open.axes

    def hear(self, more: Heard) -> tuple[Heard, int]:
        """Answers that the open case got; returns all of them, and when its stimulus had gone."""
        assert self._open is not None
        self._open.heard += more.answers
        if more.answers:
            self.missing, self._never_came = False, 0
        return Heard(tuple(self._open.heard), more.now), self._open.sent

    def worsen(
        self, name: str, verdict: Verdict, actual: str, reason: str, reading: str = ""
    ) -> None:
        """An axis gets worse, never better; the first reason of the worst verdict stays."""
        axis = self.axes[name]
        if verdict > axis.verdict:
            reading = reading or axis.reading
            self.axes[name] = Axis(verdict, axis.expected, actual, reason, reading)

    def cut_short(self, verdict: Verdict, reason: str) -> None:
        """The open case could not be judged to its end."""
        if worst(axis.verdict for axis in self.axes.values()) < Verdict.FAIL:
            self.worsen("answer", verdict, self.axes["answer"].actual, reason)

    def charge(self, late: Iterable[tuple[int, int]], reason: str, reading: str = "") -> None:
        """What came too late belongs to the case before; before the first one to nobody's."""
        if self._open is not None:
            self._open.heard += late
            codes = tuple(code for _, code in self._open.heard)
            words = answer_words(self.protocol, codes)
            if reading:  # it explains whatever else went wrong in the case
                expected = self.axes["answer"].expected
                self.axes["answer"] = Axis(Verdict.FAIL, expected, words, reason, reading)
            self.worsen("answer", Verdict.FAIL, words, reason)
            return
        if late := tuple(late):
            self.between.came(late, reason)
        else:
            self.between.silent(reason)

    @property
    def in_step(self) -> bool:
        """Whether the open case got the answers that were due: the line is between two frames."""
        return self._open is not None and self.axes["answer"].verdict < Verdict.INCONCLUSIVE

    @property
    def keeps_all(self) -> bool:
        """Whether this device takes each instruction whole, whatever came before it.

        Not known of one that loses what follows a fault, answers before the end, or waits for ever.
        """
        choices = self.profile.choices
        if "pipelining" in choices.allowed or self.profile.flushes:
            return False
        loses = any(choices.is_other(point) for point in (*LOSING, "R-answer-point"))
        return not loses and self.profile.truncation_answered is not False

    @property
    def open_id(self) -> str:
        """The open case's id, "" between cases."""
        return self._open.case.id if self._open else ""

    def wire(self, frame: bytes) -> bytes:
        """A valid frame as this device takes it, b"" for one that it does not know."""
        return on_the_wire(self.protocol, self.profile.choices, frame)

    # -- patience ---------------------------------------------------------------------------------

    def answers(self, count: int, patience: int | None = None) -> Script[Heard]:
        """Listen for answers that are due, for `patience` ns (default: `patience`).

        When not all came, `missing` says that they may still come.
        """
        patience = self.patience if patience is None else patience
        heard = yield from listen(count, patience)
        if len(heard.answers) < count:
            self.missing = True
            self.waste(patience)
        return heard

    def all_answers(self, count: int, patience: int = 0) -> Script[Heard]:
        """Listen for `count` answers, each for `patience` ns after the one before (0: `usual`)."""
        got: tuple[tuple[int, int], ...] = ()
        while True:
            heard = yield from listen(count - len(got), patience or self.usual)
            got += heard.answers
            if not heard.answers or len(got) >= count:
                return Heard(got, heard.now)

    @property
    def usual(self) -> int:
        """How long (ns) an answer may usually take: a device that is slow is slow always."""
        return max(self.limits.deadline, min(2 * self.profile.slowest, self.limits.longest))

    @property
    def timeout(self) -> int:
        """The truncation time-out (ns): the measured one, the grammar's until then."""
        usual = int(self.protocol.timing.truncation_timeout * MS)
        return self.profile.truncation_timeout or usual

    @property
    def patience(self) -> int:
        """How long (ns) to wait for an answer: until it is too late to be one.

        A device whose missing answers never came late either is not waited for so long for ever.
        """
        return self.limits.longest if self._never_came < _NEVER else self.usual

    def late(self, heard: Heard) -> None:
        """What came, or did not, after an answer was given up: charged to the case before."""
        self.missing = False
        came = heard.answers or (self._open is not None and self._open.heard)
        self._never_came = 0 if came else self._never_came + 1
        if heard.answers:
            self.charge(heard.answers, "the answer came later than the longest time allowed")

    def waste(self, time: int) -> None:
        """Count time (ns) that went into waiting for something that did not come."""
        self._wasted += time

    def check_patience(self) -> None:
        """Raise GaveUp when too much time went into waiting for answers that did not come."""
        if self.limits.waste is not None and self._wasted > self.limits.waste:
            raise GaveUp(f"{self._wasted / 1e9:.0f} s went into waiting for what did not come")

    def next_nudge(self) -> int:
        """A count that rotates through the settings that are tried after a stop."""
        self._nudges += 1
        return self._nudges

    # -- eyes -------------------------------------------------------------------------------------

    def looks_at(self, case: Case) -> bool:
        """Whether this case is looked at: every case, or the thorough ones where looks are dear."""
        return self.eyes.open and (case.thorough or not self.eyes.sparse)

    @property
    def looks_freely(self) -> bool:
        """Whether a look costs next to nothing."""
        return self.eyes.open and not self.eyes.sparse

    def blind(self, expected: str) -> Axis:
        """The axis of what cannot be seen: never a pass."""
        why = "not seen moving before" if self.looks_freely else self.eyes.why
        reason = f"{NOT_OBSERVABLE} ({why})"
        return Axis(Verdict.INCONCLUSIVE, expected, "", reason)
