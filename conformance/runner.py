"""Runs the cases: asks for send, listen and look, judges what comes back. No port, no clock.

The runner is a script (a generator of asks); a drive does what it asks, in virtual or real time.
Every way out of it homes the robot.
"""

from __future__ import annotations

from collections.abc import Sequence

from conformance.asks import Script
from conformance.cases import Case
from conformance.first_bytes import first_bytes
from conformance.homing import home, leave, see_motions
from conformance.run import Ended, GaveUp, Run
from conformance.timeout import measure_timeout, needs_timeout
from conformance.trial import try_case
from conformance.verdicts import Axis, Verdict


class Runner:
    """The script of one run over `cases`. Afterwards `books.results` holds every result.

    `measure` wants the truncation time-out measured although no case needs it. `unusable` says why
    the line could not be used at all, `ended` what ended the run early.
    """

    def __init__(
        self,
        books: Run,
        cases: Sequence[Case],
        *,
        fail_fast: bool = False,
        measure: bool = False,
    ) -> None:
        self.books = books
        self.unusable = ""
        self.ended: Ended | None = None
        self._left = list(cases)
        self._fail_fast = fail_fast
        self._measure = measure or needs_timeout(tuple(cases))

    def run(self) -> Script[None]:
        """The whole run. Always leaves by homing, if the line still works."""
        try:
            yield from self._judge_all()
        except Ended as ended:
            self.ended = ended
            verdict = Verdict.ERROR if ended.error else Verdict.INCONCLUSIVE
            if self._left and self.books.open_id == self._left[0].id:
                # Judged in part: what failed stays failed, what passed so far is no pass.
                self._left.pop(0)
                self.books.cut_short(verdict, str(ended))
            self.books.close()
            if ended.error and self._left and not self._charged():
                axis = Axis(Verdict.ERROR, "", "not judged", str(ended))
                self.books.end(self._left.pop(0), {"answer": axis})
            self._not_run(Verdict.INCONCLUSIVE, str(ended))
        if self.ended is None or self.ended.line_works:
            stopped = yield from leave(self.books)
            self.ended = self.ended or stopped

    def _judge_all(self) -> Script[None]:
        books = self.books
        try:
            self.unusable = yield from first_bytes(books)
            if self.unusable:
                return
            yield from home(books)
            yield from see_motions(books)
            if self._measure and books.profile.truncation_timeout is None:
                yield from measure_timeout(books)
                yield from home(books)
            while self._left and not self._enough():
                books.begin(self._left[0].id)
                books.check_patience()
                yield from try_case(books, self._left[0])
                self._left.pop(0)
                yield from home(books)
        except GaveUp as gave_up:
            books.close()
            self._not_run(Verdict.INCONCLUSIVE, f"precondition lost: {gave_up}")
        self._not_run(Verdict.SKIPPED, "an earlier case failed (--fail-fast)")

    def _charged(self) -> bool:
        """Whether a case bears already that the kit, the port or the probe failed."""
        return any(result.verdict is Verdict.ERROR for result in self.books.results)

    def _enough(self) -> bool:
        failed = any(result.verdict is Verdict.FAIL for result in self.books.results)
        return self._fail_fast and failed

    def _not_run(self, verdict: Verdict, reason: str) -> None:
        while self._left:
            self.books.end(self._left.pop(0), {"answer": Axis(verdict, "", "not run", reason)})
