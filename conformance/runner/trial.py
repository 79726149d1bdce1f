"""A trial: one attempt at a case while it is under way, and what it has shown so far."""

from __future__ import annotations

from dataclasses import dataclass

from bilprov.analyzer.client.operations import Ended, Received, Reconnected
from bilprov.captures.schemas import Look
from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.oracle.judge import answer_words, matching
from bilprov.conformance.oracle.sight import SEEN_AXES
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict, worst
from bilprov.conformance.runner.run import Run, result_of
from bilprov.conformance.runner.waiting import GaveUp
from bilprov.spec.readings import POINTS


@dataclass(frozen=True, slots=True)
class Late:
    """Answers that came while the line was homed, as (time in ns, code), and why they are wrong.

    Without answers the device has stopped answering. `reading` explains every other deviation too.
    """

    answers: tuple[tuple[int, int], ...]
    reason: str
    reading: str = ""


@dataclass(frozen=True, slots=True)
class Homed:
    """What homing has shown: late answers in order, and what stopped it, None if nothing did.

    `first` is the first answer that its stops got together, None if they got none.
    """

    late: tuple[Late, ...] = ()
    stopped: Ended | GaveUp | None = None
    first: int | None = None


class Trial:
    """One attempt at a case: its axes and answers so far, and the state the robot must have.

    It is `begun` once its stimulus has been sent: answers from then on belong to the case. `sent`
    is when that was (ns), `expected` the state that the robot must have now, `before` the one
    before the stimulus. It is `settled` once a silence has shown that its stimulus was not answered
    twice. `preamble` are the frames before the stimulus and `look_before` the look after them, if
    there was one; `already` is how the state that failed was wrong even then, "" if it was not.
    """

    def __init__(self, run: Run, case: Case | SequenceCase) -> None:
        self.run = run
        self.case = case
        self.axes: dict[str, Axis] = {}
        self.heard: list[tuple[int, int]] = []
        self.sent = 0
        self.settled = False
        self.before = self.expected = run.model.found()
        self.preamble: tuple[bytes, ...] = ()
        self.look_before: Look | None = None
        self.already = ""

    def begin(
        self, case: Case | SequenceCase, axes: dict[str, Axis], heard: Received, sent: int
    ) -> None:
        """Begin to judge the case, as it was adapted to the device; `sent` is in ns."""
        self.case, self.axes, self.heard, self.sent = case, dict(axes), list(heard.answers), sent

    @property
    def begun(self) -> bool:
        """Whether the stimulus was sent."""
        return bool(self.axes)

    @property
    def in_step(self) -> bool:
        """Whether the case got its due answers, so that the line is at a frame boundary."""
        return self.begun and self.axes["answer"].verdict < Verdict.INCONCLUSIVE

    def hear(self, more: Received) -> tuple[Received, int]:
        """Add answers; return all that the case got, and when its stimulus was sent (ns)."""
        self.heard += more.answers
        if more.answers:
            self.run.waiting.answered()
        return Received(tuple(self.heard), more.now), self.sent

    def worsen(
        self, name: str, verdict: Verdict, actual: str, reason: str, reading: str | None = None
    ) -> None:
        """Worsen an axis, never improve it; on a tie the first reason stays."""
        axis = self.axes[name]
        if verdict > axis.verdict:
            reading = reading or axis.reading
            self.axes[name] = Axis(verdict, axis.expected, actual, reason, reading)

    def end(self, homed: Homed) -> CaseResult:
        """The result of the attempt, after the homing that followed it."""
        for late in () if self._cut_by_look else homed.late:
            self._came_late(late)
        if isinstance(homed.stopped, Ended):
            self._cut_short(homed.stopped)
        self._keep_to_choice()
        return result_of(self.case, self.axes, self.heard, self.sent)

    @property
    def _cut_by_look(self) -> bool:
        """Whether a look through a foreign probe ended a sequence, with answers still to come."""
        failed = any(
            self.axes[name].verdict is Verdict.FAIL for name in SEEN_AXES if name in self.axes
        )
        foreign = self.run.config.observability.foreign
        return foreign and failed and isinstance(self.case, SequenceCase)

    def _came_late(self, late: Late) -> None:
        """Count late or missing answers against the case."""
        self.heard += late.answers
        words = answer_words(self.run.protocol, tuple(code for _, code in self.heard))
        if late.reading:
            expected = self.axes["answer"].expected
            self.axes["answer"] = Axis(Verdict.FAIL, expected, words, late.reason, late.reading)
        self.worsen("answer", Verdict.FAIL, words, late.reason)

    def _cut_short(self, ended: Ended) -> None:
        """Judge what was seen in part: a failure stays, but what passed so far is no pass.

        What failed before the port was missed may have failed because it was gone.
        """
        verdict = Verdict.ERROR if ended.error else Verdict.INCONCLUSIVE
        if isinstance(ended, Reconnected):
            after = f"; not tried again: {ended}"
            self.axes = {name: axis.uncertain(after=after) for name, axis in self.axes.items()}
        if not self.begun:
            actual = "not judged" if ended.error else "not run"
            self.axes = {"answer": Axis(verdict, "", actual, str(ended))}
        elif worst(axis.verdict for axis in self.axes.values()) < Verdict.FAIL:
            self.worsen("answer", verdict, self.axes["answer"].actual, str(ended))

    def _keep_to_choice(self) -> None:
        """Fail a case in which the device contradicts its earlier choice of an open point."""
        case = self.case
        if (
            isinstance(case, SequenceCase)
            or not case.point
            or self.axes["answer"].verdict >= Verdict.INCONCLUSIVE
        ):
            return
        codes = tuple(code for _, code in self.heard)
        choice = matching(case.accepted, codes)
        if choice is None:
            return
        word = choice.word or POINTS[case.point].default
        contradiction = self.run.profile.choices.record(case.point, word, case.id)
        if contradiction:
            words, reading = answer_words(self.run.protocol, codes), POINTS[case.point].reading
            self.worsen("answer", Verdict.FAIL, words, contradiction, reading)
