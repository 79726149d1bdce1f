"""Executes the test cases of a run and judges them. No port, no clock.

The runner is a procedure (a generator of operations); a link does them, in virtual or real time.
Every exit homes the robot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from bilprov.conformance.cases.budget import before_the_cases, seconds, within
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.dut.operations import Ended, Procedure
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict
from bilprov.conformance.runner.discovery.discover import discover
from bilprov.conformance.runner.first_choices import first_choices
from bilprov.conformance.runner.homing import home, leave, see_motions
from bilprov.conformance.runner.power_on import calibrate, first_bytes
from bilprov.conformance.runner.retry import judge_case
from bilprov.conformance.runner.run import Run
from bilprov.conformance.runner.settings import other_settings
from bilprov.conformance.runner.tally import tallied
from bilprov.conformance.runner.truncation_timeout import measure_timeout, needs_timeout
from bilprov.conformance.runner.waiting import GaveUp

_SLOW = 0.005  # s for an answer
SkipPolicy = Callable[[str, Sequence[CaseResult]], bool]


class Runner:
    """The procedure of one run over `cases`. Afterwards `run.results` holds every result.

    `measure` has the truncation time-out measured even if no case needs it, `discover` has the
    device's choices found out. `spare` is called before each case with its id and the results so
    far, and returns whether to skip it. `unusable` says why the line could not be used at all,
    `ended` what ended the run early.
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
    ) -> None:
        self._spare = spare
        self.run = run
        self.unusable = ""
        self.ended: Ended | None = None
        self._left = list(cases)
        self._fail_fast = fail_fast
        self._measure = measure or discover or needs_timeout(cases)
        self._discover = discover

    def execute(self) -> Procedure[None]:
        """Do the whole run. Always ends by homing the robot, if the line still works."""
        yield from tallied(self._execute(), self.run.tally)

    def _execute(self) -> Procedure[None]:
        run = self.run
        try:
            yield from self._judge_all()
        except Ended as ended:
            self.ended = ended
            if ended.error and self._left and not self._charged():
                self._result(Verdict.ERROR, "not judged", str(ended))
            self._not_run(Verdict.INCONCLUSIVE, str(ended))
        run.strays.close(keeps_all=run.keeps_all)
        if self.ended is None or self.ended.line_works:
            stopped = yield from leave(run)
            self.ended = self.ended or stopped

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
            yield from see_motions(run)
            if run.profile.moves == set():
                motion = yield from other_settings(run)
                run.profile.moves = {motion} if motion else set()
            if self._measure and run.profile.truncation_timeout is None:
                yield from measure_timeout(run)
            if self._discover:
                yield from discover(run)
            self._fit()
            while self._left and not self._enough():
                case = self._left[0]
                if self._spare and self._spare(case.id, run.results):
                    self._result(Verdict.SKIPPED, "not run", "spared")
                    continue
                run.begin(case.id)
                run.waiting.require_budget()
                judged = yield from judge_case(run, case)
                self._left.pop(0)
                run.publish(judged.result)
                if judged.stopped:
                    raise judged.stopped
        except GaveUp as gave_up:
            self._not_run(Verdict.INCONCLUSIVE, f"precondition lost: {gave_up}")
        self._not_run(Verdict.SKIPPED, "an earlier case failed (--fail-fast)")

    def _tell_slow(self) -> None:
        """Tell how long a device takes whose answers are late, and what that makes of the run."""
        run = self.run
        takes = run.profile.round_trip or 0
        on_time = takes <= run.timers.deadline
        if on_time and (run.config.virtual or takes < _SLOW * 1e9):
            return
        whole, cases = run.timers.run_budget, sum(map(self._cost, self._left))
        timeout = run.waiting.timeout / 1e9
        probes = before_the_cases(timeout, takes / 1e9) if self._discover else 0.0
        about = f"the run takes about {probes + cases:.0f} s more"
        if whole is not None and cases > whole / 1e9:
            about = (
                f"the cases would take {cases:.0f} s and get {whole / 1e9:.0f} s: --budget S "
                "gives them more"
            )
        if on_time:
            run.note(f"an answer takes {takes / 1e6:.0f} ms: {about}")
            return
        run.note(
            f"an answer takes {takes / 1e6:.0f} ms and is due after {run.timers.deadline / 1e6:.0f}"
            f" ms: slow, non-strict (R-answer-deadline); {about}"
        )

    def _cost(self, case: AnyCase) -> float:
        """About how long (s) a case takes with this device."""
        run = self.run
        slow, timeout = (run.profile.round_trip or 0) / 1e9, run.waiting.timeout / 1e9
        return seconds(run.protocol, case, 0.0, timeout, slow)

    def _fit(self) -> None:
        """Skip the cases for which a slow device leaves no time in the run's budget."""
        run = self.run
        whole, slow = run.timers.run_budget, (run.profile.round_trip or 0) / 1e9
        if whole is None or slow < _SLOW:
            return
        kept = {c.id for c in within(run.protocol, self._left, whole / 1e9, self._cost)}
        why = (
            f"an answer takes {slow * 1000:.0f} ms: {whole / 1e9:.0f} s do not hold every case; "
            "--budget S gives them more"
        )
        for case in [case for case in self._left if case.id not in kept]:
            run.conclude(case, {"answer": Axis(Verdict.SKIPPED, "", "not run", why)})
        self._left = [case for case in self._left if case.id in kept]

    def _charged(self) -> bool:
        """Whether a case already has the verdict that the kit, the port or the probe failed."""
        return any(result.verdict is Verdict.ERROR for result in self.run.results)

    def _enough(self) -> bool:
        return self._fail_fast and any(r.verdict is Verdict.FAIL for r in self.run.results)

    def _not_run(self, verdict: Verdict, reason: str) -> None:
        while self._left:
            self._result(verdict, "not run", reason)

    def _result(self, verdict: Verdict, actual: str, reason: str) -> None:
        """Publish a result of the next case, which is not executed."""
        axis = Axis(verdict, "", actual, reason)
        self.run.conclude(self._left.pop(0), {"answer": axis})
