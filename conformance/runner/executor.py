"""Runs the cases: asks for send, listen and look, judges what comes back. No port, no clock.

The runner is a script (a generator of asks); a drive does what it asks, in virtual or real time.
Every way out of it homes the robot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from conformance.cases.budget import within
from conformance.cases.duration import answers_in, seconds
from conformance.cases.levels import AnyCase
from conformance.dut.operations import Script
from conformance.oracle.verdicts import Axis, CaseResult, Verdict
from conformance.runner.discovery.discover import discover
from conformance.runner.first_choices import first_choices
from conformance.runner.homing import home, leave, see_motions
from conformance.runner.power_on import calibrate, first_bytes
from conformance.runner.retry import judge_case
from conformance.runner.run import Ended, GaveUp, Run
from conformance.runner.truncation_timeout import measure_timeout, needs_timeout

_SLOW = 0.005  # s for an answer
Spare = Callable[[str, Sequence[CaseResult]], bool]


class Runner:
    """The script of one run over `cases`. Afterwards `books.results` holds every result.

    `measure` wants the truncation time-out measured although no case needs it. `spare` is asked
    before each case, with its id and the results so far, whether to skip it. `unusable` says why
    the line could not be used at all, `ended` what ended the run early.
    """

    def __init__(
        self,
        books: Run,
        cases: Sequence[AnyCase],
        *,
        fail_fast: bool = False,
        measure: bool = False,
        discover: bool = True,
        spare: Spare | None = None,
    ) -> None:
        self._spare = spare
        self.books = books
        self.unusable = ""
        self.ended: Ended | None = None
        self._left = list(cases)
        self._fail_fast = fail_fast
        self._measure = measure or discover or needs_timeout(cases)
        self._discover = discover

    def run(self) -> Script[None]:
        """The whole run. Always leaves by homing, if the line still works."""
        try:
            yield from self._judge_all()
        except Ended as ended:
            self.ended = ended
            verdict = Verdict.ERROR if ended.error else Verdict.INCONCLUSIVE
            self.books.drop_tries()
            self._drop_published()
            if self._left and self.books.open_id == self._left[0].id:
                # Judged in part: what failed stays failed, what passed so far is no pass.
                self._left.pop(0)
                self.books.cut_short(verdict, str(ended))
            self.books.close()
            if ended.error and self._left and not self._charged():
                axis = Axis(Verdict.ERROR, "", "not judged", str(ended))
                self.books.end(self._left.pop(0), {"answer": axis})
            self._not_run(Verdict.INCONCLUSIVE, str(ended))
        self.books.between.close(keeps_all=self.books.keeps_all)
        if self.ended is None or self.ended.line_works:
            stopped = yield from leave(self.books)
            self.ended = self.ended or stopped

    def _judge_all(self) -> Script[None]:
        books = self.books
        try:
            self.unusable = yield from first_bytes(books)
            if self.unusable:
                return
            if self._discover:
                yield from first_choices(books)
            yield from home(books)
            yield from calibrate(books)
            yield from home(books)
            yield from see_motions(books)
            if self._measure and books.profile.truncation_timeout is None:
                yield from measure_timeout(books)
            if self._discover:
                yield from discover(books)
            self._fit()
            while self._left and not self._enough():
                if self._spare and self._spare(self._left[0].id, books.results):
                    axis = Axis(Verdict.SKIPPED, "", "not run", "spared")
                    books.end(self._left.pop(0), {"answer": axis})
                    continue
                books.begin(self._left[0].id)
                books.check_patience()
                yield from judge_case(books, self._left[0])
                self._left.pop(0)
        except GaveUp as gave_up:
            books.trying = books.suspect = None
            books.close()
            self._drop_published()
            self._not_run(Verdict.INCONCLUSIVE, f"precondition lost: {gave_up}")
        self._not_run(Verdict.SKIPPED, "an earlier case failed (--fail-fast)")

    def _fit(self) -> None:
        """Leave out what a slow device has no time for; what is left out is listed as skipped."""
        books = self.books
        whole, slow = books.limits.whole, (books.profile.round_trip or 0) / 1e9
        if whole is None or slow < _SLOW:
            return
        timeout = books.timeout / 1e9

        def cost(case: AnyCase) -> float:
            return seconds(books.protocol, case, 0.0, timeout) + answers_in(case) * slow

        kept = {c.id for c in within(books.protocol, self._left, whole / 1e9, cost)}
        why = (
            f"an answer takes {slow * 1000:.0f} ms: {whole / 1e9:.0f} s do not hold every case; "
            "--budget S gives them more"
        )
        for case in [case for case in self._left if case.id not in kept]:
            books.end(case, {"answer": Axis(Verdict.SKIPPED, "", "not run", why)})
        self._left = [case for case in self._left if case.id in kept]

    def _drop_published(self) -> None:
        """The case that ran has its result already, also if trying it again came to no end."""
        results = self.books.results
        if self._left and results and results[-1].id == self._left[0].id:
            self._left.pop(0)

    def _charged(self) -> bool:
        """Whether a case bears already that the kit, the port or the probe failed."""
        return any(result.verdict is Verdict.ERROR for result in self.books.results)

    def _enough(self) -> bool:
        return self._fail_fast and any(r.verdict is Verdict.FAIL for r in self.books.results)

    def _not_run(self, verdict: Verdict, reason: str) -> None:
        while self._left:
            self.books.end(self._left.pop(0), {"answer": Axis(verdict, "", "not run", reason)})
