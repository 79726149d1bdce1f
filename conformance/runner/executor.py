"""Executes the test cases of a run and judges them. No port, no clock.

The runner is a procedure (a generator of operations); a link does them, in virtual or real time.
Every exit homes the robot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from bilprov.conformance.cases.budget import within
from bilprov.conformance.cases.duration import answers_in, seconds
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.dut.operations import Ended, Procedure
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict
from bilprov.conformance.runner.discovery.discover import discover
from bilprov.conformance.runner.first_choices import first_choices
from bilprov.conformance.runner.homing import home, leave, see_motions
from bilprov.conformance.runner.power_on import calibrate, first_bytes
from bilprov.conformance.runner.retry import judge_case
from bilprov.conformance.runner.run import GaveUp, RunState
from bilprov.conformance.runner.truncation_timeout import measure_timeout, needs_timeout

_SLOW = 0.005  # s for an answer
SkipPolicy = Callable[[str, Sequence[CaseResult]], bool]


class Runner:
    """The procedure of one run over `cases`. Afterwards `state.results` holds every result.

    `measure` has the truncation time-out measured even if no case needs it, `discover` has the
    device's choices found out. `spare` is called before each case with its id and the results so
    far, and returns whether to skip it. `unusable` says why the line could not be used at all,
    `ended` what ended the run early.
    """

    def __init__(
        self,
        state: RunState,
        cases: Sequence[AnyCase],
        *,
        fail_fast: bool = False,
        measure: bool = False,
        discover: bool = True,
        spare: SkipPolicy | None = None,
    ) -> None:
        self._spare = spare
        self.state = state
        self.unusable = ""
        self.ended: Ended | None = None
        self._left = list(cases)
        self._fail_fast = fail_fast
        self._measure = measure or discover or needs_timeout(cases)
        self._discover = discover

    def run(self) -> Procedure[None]:
        """Do the whole run. Always ends by homing the robot, if the line still works."""
        try:
            yield from self._judge_all()
        except Ended as ended:
            self.ended = ended
            verdict = Verdict.ERROR if ended.error else Verdict.INCONCLUSIVE
            self.state.drop_tries()
            self._drop_published()
            if self._left and self.state.open_id == self._left[0].id:
                # Judged in part: a failure stays, but what passed so far is no pass.
                self._left.pop(0)
                self.state.cut_short(verdict, str(ended))
            self.state.close()
            if ended.error and self._left and not self._charged():
                axis = Axis(Verdict.ERROR, "", "not judged", str(ended))
                self.state.end(self._left.pop(0), {"answer": axis})
            self._not_run(Verdict.INCONCLUSIVE, str(ended))
        self.state.stray_answers.close(keeps_all=self.state.keeps_all)
        if self.ended is None or self.ended.line_works:
            stopped = yield from leave(self.state)
            self.ended = self.ended or stopped

    def _judge_all(self) -> Procedure[None]:
        state = self.state
        try:
            self.unusable = yield from first_bytes(state)
            if self.unusable:
                return
            if self._discover:
                yield from first_choices(state)
            yield from home(state)
            yield from calibrate(state)
            yield from home(state)
            yield from see_motions(state)
            if self._measure and state.profile.truncation_timeout is None:
                yield from measure_timeout(state)
            if self._discover:
                yield from discover(state)
            self._fit()
            while self._left and not self._enough():
                if self._spare and self._spare(self._left[0].id, state.results):
                    axis = Axis(Verdict.SKIPPED, "", "not run", "spared")
                    state.end(self._left.pop(0), {"answer": axis})
                    continue
                state.begin(self._left[0].id)
                state.check_patience()
                yield from judge_case(state, self._left[0])
                self._left.pop(0)
        except GaveUp as gave_up:
            state.trying = state.suspect = None
            state.close()
            self._drop_published()
            self._not_run(Verdict.INCONCLUSIVE, f"precondition lost: {gave_up}")
        self._not_run(Verdict.SKIPPED, "an earlier case failed (--fail-fast)")

    def _fit(self) -> None:
        """Skip the cases for which a slow device leaves no time in the run's budget."""
        state = self.state
        whole, slow = state.timers.run_budget, (state.profile.round_trip or 0) / 1e9
        if whole is None or slow < _SLOW:
            return
        timeout = state.timeout / 1e9

        def cost(case: AnyCase) -> float:
            return seconds(state.protocol, case, 0.0, timeout) + answers_in(case) * slow

        kept = {c.id for c in within(state.protocol, self._left, whole / 1e9, cost)}
        why = (
            f"an answer takes {slow * 1000:.0f} ms: {whole / 1e9:.0f} s do not hold every case; "
            "--budget S gives them more"
        )
        for case in [case for case in self._left if case.id not in kept]:
            state.end(case, {"answer": Axis(Verdict.SKIPPED, "", "not run", why)})
        self._left = [case for case in self._left if case.id in kept]

    def _drop_published(self) -> None:
        """Drop the current case from the list if its result is published already."""
        results = self.state.results
        if self._left and results and results[-1].id == self._left[0].id:
            self._left.pop(0)

    def _charged(self) -> bool:
        """Whether a case already has the verdict that the kit, the port or the probe failed."""
        return any(result.verdict is Verdict.ERROR for result in self.state.results)

    def _enough(self) -> bool:
        return self._fail_fast and any(r.verdict is Verdict.FAIL for r in self.state.results)

    def _not_run(self, verdict: Verdict, reason: str) -> None:
        while self._left:
            self.state.end(self._left.pop(0), {"answer": Axis(verdict, "", "not run", reason)})
