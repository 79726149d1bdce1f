"""Executes the test cases of a run and judges them. No port, no clock.

The runner is a procedure (a generator of operations); a link does them, in virtual or real time.
Every exit homes the robot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf

from bilprov.analyzer.client.operations import Ended, Procedure, Reconnected, followed
from bilprov.conformance.cases import budget
from bilprov.conformance.cases.budget import Pace
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict
from bilprov.conformance.runner.discovery.discover import discover, first_choices
from bilprov.conformance.runner.homing import find_speed, home, home_again, leave, see_motions
from bilprov.conformance.runner.power_on import calibrate, first_bytes
from bilprov.conformance.runner.probe_trust import probe_check
from bilprov.conformance.runner.retry import TRUSTED, Attempt, judge_case
from bilprov.conformance.runner.run import Run, result_of
from bilprov.conformance.runner.settings import other_settings
from bilprov.conformance.runner.truncation_timeout import measure_timeout, needs_timeout
from bilprov.conformance.runner.waiting import GaveUp

_SLOW = 0.005  # s for an answer or a look
_MENTIONED = 2.0  # s; what takes less longer than was announced is not told
SkipPolicy = Callable[[str, Sequence[CaseResult]], bool]


def is_slow(takes: float) -> bool:
    """Whether an answer or a look that takes so long (s) limits the run's cases."""
    return takes >= _SLOW


class Runner:
    """The procedure of one run over `cases`. Afterwards `run.results` holds every result.

    `measure` has the truncation time-out measured even if no case needs it, `discover` has the
    device's choices found out. `spare` is called before each case with its id and the results so
    far, and returns whether to skip it. `afterwards` is done when all are judged or the time is
    over, if the line still works. `unusable` says why the line could not be used at all, `ended`
    what ended the run early.
    """

    def __init__(
        self,
        run: Run,
        cases: Sequence[AnyCase],
        *,
        fail_fast: bool = False,
        measure: bool = False,
        discover: bool = True,
        spare: SkipPolicy | None = None,
        afterwards: Callable[[], Procedure[None]] | None = None,
    ) -> None:
        self._spare = spare
        self._afterwards = afterwards
        self.run = run
        self.unusable = ""
        self.ended: Ended | None = None
        self._left = list(cases)
        self._fail_fast = fail_fast
        self._measure = measure or discover or needs_timeout(cases)
        self._discover = discover

    def execute(self) -> Procedure[None]:
        """Do the whole run. Always ends by homing the robot, if the line still works."""
        run = self.run
        yield from followed(self._execute(), run, run.limit, run.sight, look=run.looks.observe)

    def _execute(self) -> Procedure[None]:
        run = self.run
        try:
            yield from self._judge_all()
        except Ended as ended:
            self.ended = ended
            charged = any(result.verdict is Verdict.ERROR for result in run.results)
            if ended.error and self._left and not charged:
                self._result(Verdict.ERROR, "not judged", str(ended))
            self._not_run(Verdict.INCONCLUSIVE, str(ended))
        run.release(str(self.ended or ""))
        run.strays.close(keeps_all=run.keeps_all)
        as_planned = self.ended is None or self.ended.by == "time"
        if as_planned and self._afterwards and not self.unusable:
            try:
                yield from self._afterwards()
            except Ended as ended:
                self.ended = ended
        if self.ended is None or self.ended.line_works:
            stopped = yield from leave(run)
            self.ended = self.ended or stopped
        run.release(str(self.ended or ""))
        run.tell_doubt()
        probe_check.note_no_stop(run)

    def _judge_all(self) -> Procedure[None]:
        run = self.run
        try:
            self.unusable = yield from first_bytes(run)
            if self.unusable:
                return
            if self._discover:
                yield from first_choices(run)
            yield from home(run)
            yield from calibrate(run)
            self._tell_slow()
            yield from home(run)
            yield from probe_check.first_looks(run)
            yield from see_motions(run)
            if run.profile.moves == set():
                motion = yield from other_settings(run)
                run.profile.moves = {motion} if motion else set()
            yield from find_speed(run)
            if self._measure and run.profile.truncation_timeout is None:
                yield from measure_timeout(run)
            if self._discover:
                yield from discover(run)
            if run.profile.keeps_waiting:
                run.notices.append(
                    "the device never gives up a frame that was cut short: the document is silent "
                    "on a time-out; this kit asks for one because of "
                    f"{run.protocol.clauses.safety} (a faulty instruction stops the robot at once)"
                )
            yield from probe_check.settle_failures(run)
            self._fit()
            self._tell_longer()
            while self._left:
                if self._fail_fast and any(r.verdict is Verdict.FAIL for r in run.results):
                    break
                case = self._left[0]
                if self._spare and self._spare(case.id, run.results):
                    self._result(Verdict.SKIPPED, "not run", "spared")
                    continue
                if run.line.forbids(case):
                    self._result(Verdict.INCONCLUSIVE, "not run", run.line.sentence)
                    continue
                run.begin(case.id)
                run.waiting.require_budget()
                run.limit.require()
                judged = yield from self._judged(case)
                self._left.pop(0)
                run.publish(judged.result)
                if not judged.stopped:
                    yield from probe_check.settle_failures(run)
                if isinstance(judged.stopped, Reconnected):
                    label = judged.result.verdict.label
                    run.note(f"{judged.stopped}; {case.id}: {label}, and the run goes on")
                    yield from self._resume(judged.stopped)
                elif judged.stopped:
                    raise judged.stopped
        except GaveUp as gave_up:
            self._not_run(Verdict.INCONCLUSIVE, f"precondition lost: {gave_up}")
        self._not_run(Verdict.SKIPPED, "an earlier case failed (--fail-fast)")

    def _judged(self, case: AnyCase) -> Procedure[Attempt]:
        """Judge a case; one during which the port was lost and found again is inconclusive."""
        try:
            return (yield from judge_case(self.run, case))
        except Reconnected as gap:
            axis = Axis(Verdict.INCONCLUSIVE, "", "not judged", str(gap))
            return Attempt(result_of(case, {"answer": axis}), stopped=gap)

    def _resume(self, gap: Reconnected) -> Procedure[None]:
        """Go on at a port that is there again: home the robot, however often the port is lost."""
        run = self.run
        while True:
            run.limit.leave_out(gap.now - gap.lost)
            try:
                yield from home_again(run)
            except Reconnected as another:
                gap = another
                run.note(f"{gap}; the run goes on")
            else:
                return

    def _tell_slow(self) -> None:
        """Tell how long slow answers and slow looks take, and what that makes of the run."""
        run, pace, virtual = self.run, self._pace(), self.run.config.virtual
        takes, due = run.profile.round_trip or 0, run.timers.deadline
        slow_answers = takes > due or (is_slow(pace.answer) and not virtual)
        told = slow_answers or is_slow(pace.look)
        if virtual and not told:
            return
        cases = sum(map(self._cost, self._left))
        more = min(cases, self._whole) + (budget.before_the_cases(pace) if self._discover else 0.0)
        about = f"the run takes about {more:.0f} s more"
        if cases > self._whole:
            about = (
                f"the cases would take {cases:.0f} s and get {self._whole:.0f} s: those that add "
                "least are left out"
            )
        run.limit.announce(more)
        if takes > due:
            run.note(
                f"an answer takes {takes / 1e6:.0f} ms and is due after {due / 1e6:.0f} ms: slow, "
                f"non-strict (R-answer-deadline); {about}"
            )
        elif told:
            run.note(f"{self._slow_words(pace)}: {about}")

    def _tell_longer(self) -> None:
        """Announce anew how long the run takes with what was found out about the device."""
        run, pace, profile = self.run, self._pace(), self.run.profile
        if run.config.virtual:
            return
        usual = replace(pace, timeout=run.protocol.timing.truncation_timeout / 1000)
        cases = sum(budget.seconds(run.protocol, case, usual) for case in self._left)
        found = {
            f"ends a frame that was cut short only after {pace.timeout * 1e3:.0f} ms": (
                sum(map(self._cost, self._left)) - cases
            )
        }
        if profile.keeps_waiting:
            wasted = budget.waits_in_vain(
                self._left, run.protocol.timing.answer_longest / 1000, TRUSTED
            )
            most = run.timers.waiting_budget
            vain = wasted if most is None else min(wasted, most / 1e9)
            found["never gives up a frame that was cut short"] = vain
        if profile.flushes:
            pauses = sum(map(budget.faults_of, self._left)) * run.waiting.idle / 1e9
            found["discards what follows a fault until the line is idle"] = pauses
        longer = {what: more for what, more in found.items() if more >= _MENTIONED}
        if longer:
            more = sum(longer.values())
            cases = min(cases, self._whole) if self._is_slow else cases
            run.limit.announce(cases + more)
            run.note(f"this device {' and '.join(longer)}: the run takes about {more:.0f} s more")

    @property
    def _whole(self) -> float:
        """How long (s) all cases may take on a slow line."""
        whole = self.run.timers.run_budget
        return inf if whole is None else whole / 1e9

    @property
    def _is_slow(self) -> bool:
        """Whether answers or looks are so slow that the cases may take too long."""
        pace = self._pace()
        return is_slow(max(pace.answer, pace.look))

    def _slow_words(self, pace: Pace) -> str:
        """What is slow, and how long it takes."""
        both = (("an answer", pace.answer), ("an observation", pace.look))
        slow = (f"{name} takes {takes * 1e3:.0f} ms" for name, takes in both if is_slow(takes))
        return " and ".join(slow)

    def _pace(self) -> Pace:
        """How fast device and probe are, as far as it is known."""
        config, profile = self.run.config, self.run.profile
        look = config.look_time / 1e9 if config.observability.available else 0.0
        answer, timeout = (profile.round_trip or 0) / 1e9, self.run.waiting.timeout / 1e9
        return Pace(timeout, 0.0, answer, look, few_looks=not config.observable)

    def _cost(self, case: AnyCase) -> float:
        """About how long (s) a case takes with this device."""
        return budget.seconds(self.run.protocol, case, self._pace())

    def _fit(self) -> None:
        """Skip the cases for which a slow device or probe leaves no time.

        A group that loses every case was not tested: those of its cases are inconclusive.
        """
        run = self.run
        if self._whole == inf or not self._is_slow:
            return
        kept = {c.id for c in budget.within(run.protocol, self._left, self._whole, self._cost)}
        why = f"{self._slow_words(self._pace())}: {self._whole:.0f} s are too short for every case"
        tested = {budget.group(ident) for ident in kept}
        for case in [case for case in self._left if case.id not in kept]:
            skipped = budget.group(case.id) in tested
            verdict = Verdict.SKIPPED if skipped else Verdict.INCONCLUSIVE
            run.conclude(case, {"answer": Axis(verdict, "", "not run", why)})
        self._left = [case for case in self._left if case.id in kept]

    def _not_run(self, verdict: Verdict, reason: str) -> None:
        while self._left:
            self._result(verdict, "not run", reason)

    def _result(self, verdict: Verdict, actual: str, reason: str) -> None:
        """Publish a result of the next case, which is not executed."""
        axis = Axis(verdict, "", actual, reason)
        self.run.conclude(self._left.pop(0), {"answer": axis})
