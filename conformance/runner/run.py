"""State of one run: configuration, the device's profile, waiting policy, counters, results.

A case that is under way has a state of its own, a `Trial`. Answers that came or are missing
outside any case are collected: isolated ones are inconclusive; repeated ones fail
`line/unsolicited`, silence fails `line/lost`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from itertools import islice
from math import sqrt

import msgspec

from bilprov.analyzer.client.operations import Ended, Operation, Received, Reconnected, Reply, Send
from bilprov.captures.schemas import Look
from bilprov.conformance.cases.adaptation import on_the_wire
from bilprov.conformance.cases.case import Case, case_of_the_run
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.dut.target import Observability
from bilprov.conformance.oracle.judge import answer_words, matching
from bilprov.conformance.oracle.profile import Profile, Timers
from bilprov.conformance.oracle.sight import NOT_OBSERVABLE, SEEN_AXES, Sight
from bilprov.conformance.oracle.state_model import Model
from bilprov.conformance.oracle.verdicts import AnswerByte, Axis, CaseResult, Verdict, worst
from bilprov.conformance.runner.probe_trust.looks import Looks
from bilprov.conformance.runner.waiting import CoarseLine, GaveUp, TimeLimit, Waiting
from bilprov.spec.codec import spaced
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import FLUSH_POINTS, POINTS

Answers = tuple[tuple[int, int], ...]

SPOILT = 1e-3
"""Share of the bytes on a line that noise may spoil."""

_STRAYS = 3  # stray answers at once: so many are no noise but a failure of the device
_SEVERAL = 5  # of them in a run, beyond what noise may make of all its bytes


class StrayAnswers:
    """Collects stray and missing answers of a run, and has it publish a case for them.

    A single stray or lost byte may be noise on the line: inconclusive. A flood or repeated stray
    answers are the device's failure, and so is a device that stops answering; on a lossless line
    so is every one. The more bytes went over the line so far, the more of them noise may have
    spoilt: four standard deviations above their number are no chance.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._lossless = run.config.lossless
        self._strays: list[tuple[Answers, str]] = []
        self._stray = False
        self._lost = 0

    def unexpected(self, answers: Iterable[tuple[int, int]], reason: str) -> None:
        """Record answers, as (time in ns, code), that no instruction asked for, until reported."""
        if self._stray:
            return
        came = tuple(answers)
        self._strays.append((came, reason))
        spoilt = SPOILT * self._run.bytes
        many = len(self._strays) >= _SEVERAL + spoilt + 4 * sqrt(spoilt)
        if self._lossless or many or len(came) >= _STRAYS:
            self._end_strays(certain=many or len(came) >= _STRAYS)

    def missing(self, count: int) -> None:
        """Record `count` unanswered instructions of a device that went on answering."""
        self._lost += count

    def silent(self, reason: str) -> None:
        """Report that the device stopped answering: a failure."""
        self._lost = 0
        self._silence(reason)

    def close(self, *, keeps_all: bool) -> None:
        """Report at the run's end what was recorded, as inconclusive.

        Missing answers count only if the device `keeps_all`, that is takes each instruction
        regardless of what preceded it; any other may discard what follows a fault.
        """
        if self._strays:
            self._end_strays()
        if self._lost and keeps_all:
            self._silence("no answer came where no case was judged", self._lost)

    def _silence(self, reason: str, times: int = 0) -> None:
        """Publish the failure, which may be noise where it was met so many `times`."""
        case = case_of_the_run(self._run.protocol, "line/lost")
        axis = Axis(Verdict.FAIL, "each instruction answered once", "no answer", reason)
        if times:
            axis = self._run.config.unsteady(axis, times, "the run")
        self._run.conclude(case, {"answer": axis}, certain=True)

    def _end_strays(self, *, certain: bool = False) -> None:
        """Publish them once as a failure; unless it is `certain` they may be noise."""
        if self._stray:
            return
        self._stray = True
        came = tuple(answer for answers, _ in self._strays for answer in answers)
        words = answer_words(self._run.protocol, tuple(code for _, code in came))
        axis = Axis(Verdict.FAIL, "no answer", words, self._strays[-1][1], "R-unsolicited")
        if not certain:
            axis = self._run.config.unsteady(axis, len(self._strays), "the run")
        case = case_of_the_run(self._run.protocol, "line/unsolicited")
        self._run.conclude(case, {"answer": axis}, came, came[0][0])


@dataclass(frozen=True, slots=True)
class RunConfig:
    """What is settled before a run begins.

    `power` says whether the robot can be switched off and on, `virtual` whether the device is an
    object in virtual time: what answers is then no other device, baud rate or program. `lossless`
    declares that the line loses nothing: what is not reproduced there is no noise. `look_time` is
    how long (ns) a look takes, as far as that is known, `announced` how long (s) the run was said
    to take (`runner.waiting`).
    """

    protocol: Protocol
    timers: Timers
    observability: Observability
    power: bool = False
    virtual: bool = True
    lossless: bool = False
    look_time: int = 0
    announced: float | None = None

    @property
    def observable(self) -> bool:
        """Whether looks are available and cheap."""
        return self.observability.available and not self.observability.costly

    def unsteady(self, axis: Axis, met: int, of: str) -> Axis:
        """The axis of what may be noise: flaky, thus inconclusive.

        On a lossless line what failed stays a failure. `met` is how often it was met, `of` names
        the tries or the run in which it was.
        """
        times = "once" if met == 1 else f"{met} times"
        verdict, words = Verdict.INCONCLUSIVE, f"flaky, met {times} in {of}"
        if self.lossless and axis.verdict is Verdict.FAIL:
            verdict, words = Verdict.FAIL, f"met {times} in {of}, on a line that loses nothing"
        reason = f"{words}: {axis.reason}".rstrip(": ")
        return msgspec.structs.replace(axis, verdict=verdict, reason=reason)

    def not_observable(self, expected: str) -> Axis:
        """The axis of something that cannot be observed: inconclusive, never a pass."""
        why = "not seen moving before" if self.observable else self.observability.why
        reason = f"{NOT_OBSERVABLE} ({why})"
        return Axis(Verdict.INCONCLUSIVE, expected, "", reason)


@dataclass
class Counters:
    """Counters of a run that decide what is tried again.

    `flaky` and `reproduced` failures, sequences `minimised`, stops that were missed beside right
    answers, `floods` of answers.
    """

    flaky: int = 0
    reproduced: int = 0
    minimised: int = 0
    missed_stops: int = 0
    floods: int = 0
    _checks: int = 0
    _held: dict[tuple[str, tuple[int, ...]], str] = field(default_factory=dict)

    def next_check(self) -> int:
        """The next value of a counter that rotates through the checks after a stop."""
        self._checks += 1
        return self._checks

    def hold(self, case: Case, timers: Timers) -> int:
        """How long (ns) the stop of this case is watched: 0 but for one thorough case of a class.

        So is one valid stop. This one, and that of one fault, are watched for as long as a moving
        robot is sent nothing.
        """
        valid = case.kind is FrameClass.VALID
        key = (case.kind, case.accepted[0].codes)
        if not (valid or case.thorough) or self._held.setdefault(key, case.id) != case.id:
            return 0
        faults = (ident for (kind, _), ident in self._held.items() if kind is not FrameClass.VALID)
        first = valid or case.id == next(faults)
        return max(timers.hold, timers.idle) if first else timers.hold


def _doubted(result: CaseResult, why: str) -> CaseResult:
    """The result without the failures that rest on looks: these are inconclusive, and why."""
    return result.uncertain(after=f"; not believed: {why}", only=SEEN_AXES)


SPARE_ANSWERS = 256
"""Answers that a result keeps beyond two for each frame."""


def result_of(
    case: Case | SequenceCase,
    axes: dict[str, Axis],
    heard: Iterable[tuple[int, int]] = (),
    sent: int = 0,
) -> CaseResult:
    """The result of a case with these axes; `heard` are its answers as (time in ns, code).

    `sent` is the time (ns) when its stimulus had been sent. Of a device that floods the first
    answers are kept: twice as many as frames were sent, and SPARE_ANSWERS.
    """
    most = 2 * len(case.sent) + SPARE_ANSWERS
    verdict = worst(axis.verdict for axis in axes.values())
    counted = isinstance(case, SequenceCase) and case.seeded and verdict < Verdict.FAIL
    counted = counted and axes["answer"].verdict < Verdict.INCONCLUSIVE
    return CaseResult(
        id=case.id,
        clause=case.clause,
        requirement=case.requirement,
        verdict=verdict,
        axes=axes,
        reading=next((a.reading for a in axes.values() if a.reading), case.reading),
        sent=() if counted else tuple(spaced(frame) for frame in case.sent if frame),
        received=()
        if counted
        else tuple(AnswerByte(f"{c:02x}", (t - sent) / 1e9) for t, c in islice(heard, most)),
        frames=case.frames,
    )


class Run:
    """State of one run. `begin` and `report` are called when a case begins and when it is final.

    `note` is called with a sentence that the user should read while the run goes on; `notices` are
    sentences that belong to the report too.

    `limit` ends the run where it takes too long.

    `profile` holds what was measured of the device, `strays` the answers that belong to no case,
    `results` every final result in order, `answers` how many came, `bytes` how many went over the
    line both ways, `sight` what the looks have shown, `followed` the settings that the probe has
    shown to follow.
    """

    def __init__(
        self,
        config: RunConfig,
        profile: Profile | None = None,
        *,
        begin: Callable[[str], None] = lambda ident: None,
        report: Callable[[CaseResult], None] = lambda result: None,
        note: Callable[[str], None] = lambda sentence: None,
    ) -> None:
        self.config = config
        self.profile = profile or Profile()
        timing = config.protocol.timing
        self.waiting = Waiting(
            config.timers, self.profile, timing.truncation_timeout, timing.truncation_shortest
        )
        self.line = CoarseLine(config.protocol, self.waiting, self.profile)
        self.counters = Counters()
        self.answers = 0
        self.bytes = 0
        self.sight = Sight(config.protocol)
        self.limit = TimeLimit(config.announced)
        self.followed: set[str] = set()
        self.results: list[CaseResult] = []
        self.strays = StrayAnswers(self)
        sees = config.observability
        self._trusted = not sees.foreign
        self.looks = Looks(confirmed=sees.foreign and not sees.costly)
        self.doubt = ""
        self.waiting_failures: list[CaseResult] = []
        self.note = note
        self.notices: list[str] = []
        self._begin = begin
        self._report = report
        self._told_coarse = False

    @property
    def protocol(self) -> Protocol:
        """The protocol that the device is tested against."""
        return self.config.protocol

    @property
    def timers(self) -> Timers:
        """How long the run waits."""
        return self.config.timers

    @property
    def model(self) -> Model:
        """The model of the expected state, with the choices that the device has shown."""
        return Model(self.config.protocol, self.profile.choices)

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

    def did(self, operation: Operation, reply: Reply) -> None:
        """Take note of an operation that was done: of the bytes that went over the line."""
        if isinstance(operation, Send):
            self.bytes += len(operation.data)
        if isinstance(reply, Received):
            self.answers += len(reply.answers)
            self.bytes += len(reply.answers)

    def answered(self, frame: bytes, heard: Received, sent: int) -> None:
        """Take note of how soon the answer to a valid frame came, which had gone at `sent` (ns)."""
        self.profile.measured(heard, sent)
        if heard.answers and not self.config.virtual:
            self.profile.set_up(frame, heard.answers[0][0] - sent)

    def wire(self, frame: bytes) -> bytes:
        """A valid frame adapted to the device's choices, b"" for an unknown instruction."""
        return on_the_wire(self.protocol, self.profile.choices, frame)

    def notice(self, sentence: str) -> None:
        """Show a sentence while the run goes on, and keep it for the report."""
        self.note(sentence)
        self.notices.append(sentence)

    def begin(self, ident: str) -> None:
        """Begin a case: its looks count for its result."""
        self.sight.begin(ident)
        self._begin(ident)

    def publish(self, result: CaseResult, *, certain: bool = False) -> None:
        """Record a final result and report it.

        What its looks did not show makes it no pass, and what the line explains no failure, unless
        it is `certain` that no line does. A failure that rests on a foreign probe waits until the
        probe has been checked (`release`).
        """
        if self.profile.truncation_timeout and self.line.coarse and not self._told_coarse:
            self._told_coarse = True
            self.notice(self.line.sentence)
        if not certain:
            result = self.line.judged(result)
        result = self.sight.judged(result)
        if self.looks.contradictory and not self.doubt:
            self.distrust(self.looks.words)
        seen = (result.axes[name] for name in SEEN_AXES if name in result.axes)
        if any(axis.verdict is Verdict.FAIL for axis in seen):
            if self.doubt:
                result = _doubted(result, self.doubt)
            elif not self._trusted:
                self.waiting_failures.append(result)
                return
        self.results.append(result)
        self._report(result)

    def distrust(self, why: str) -> None:
        """Believe no look any more, and why: what rests on looks is not observable from here on."""
        self.doubt = why
        self.notice(f"{why}; what rests on observations is inconclusive from here on")
        sees = Observability(available=False, why=why, foreign=True)
        self.config = replace(self.config, observability=sees)
        if self.profile.truncation_answered is False:
            self.profile.truncation_timeout = None  # its stop alone has told it

    def release(self, ended: str = "") -> None:
        """Publish the failures that waited for the check of the probe.

        `ended` says what ended the run before it could be made, "" if nothing did: then the probe
        was checked, and is believed unless there is doubt.
        """
        waiting, self.waiting_failures = self.waiting_failures, []
        if waiting and not ended:
            self._trusted = True
        for result in waiting:
            self.publish(_doubted(result, ended) if ended else result, certain=True)

    def tell_doubt(self) -> None:
        """Publish, at the run's end, that the probe contradicted itself or was not believed."""
        why = self.doubt or self.looks.words
        if not why:
            return
        case = case_of_the_run(self.protocol, "line/probe")
        axis = Axis(
            Verdict.INCONCLUSIVE, "observations that agree", "observations that do not", why
        )
        self.conclude(case, {"state": axis})

    def conclude(
        self,
        case: Case | SequenceCase,
        axes: dict[str, Axis],
        heard: Iterable[tuple[int, int]] = (),
        sent: int = 0,
        *,
        certain: bool = False,
    ) -> None:
        """Publish the result of a case with these axes; see `result_of` and `publish`."""
        self.publish(result_of(case, axes, heard, sent), certain=certain)


# -- a trial: one attempt at a case while it is under way -----------------------------------------


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
        failed = any(
            self.axes[name].verdict is Verdict.FAIL for name in SEEN_AXES if name in self.axes
        )
        # A look through a foreign probe ends a sequence with answers still to come.
        foreign = self.run.config.observability.foreign
        cut = foreign and failed and isinstance(self.case, SequenceCase)
        for late in () if cut else homed.late:
            self.heard += late.answers
            words = answer_words(self.run.protocol, tuple(code for _, code in self.heard))
            if late.reading:
                expected = self.axes["answer"].expected
                self.axes["answer"] = Axis(Verdict.FAIL, expected, words, late.reason, late.reading)
            self.worsen("answer", Verdict.FAIL, words, late.reason)
        if isinstance(homed.stopped, Ended):
            self._cut_short(homed.stopped)
        self._keep_to_choice()
        return result_of(self.case, self.axes, self.heard, self.sent)

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
