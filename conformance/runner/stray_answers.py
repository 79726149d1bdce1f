"""Answers received or missing outside any test case.

Isolated ones are inconclusive; repeated ones fail `line/unsolicited`, silence fails `line/lost`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from bilprov.conformance.cases.case import case_of_the_run
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.oracle.wording import answer_words
from bilprov.spec.protocol import Protocol

Answers = tuple[tuple[int, int], ...]

_STRAYS = 3  # stray answers at once: so many are no noise but a failure of the device
_SEVERAL = 5  # of them in a run, beyond what noise may make of all its frames
_NOISE = 2e-3  # of frames: an instruction and its answer, each doubled once in a thousand times


class StrayAnswers:
    """Collects stray and missing answers, and has `Run.conclude` publish a case for them.

    A single stray or lost byte may be noise on the line: inconclusive. A flood or repeated stray
    answers are the device's failure, and so is a device that stops answering; on a `lossless` line
    so is every one. `frames` tells how many frames were answered so far: the more there were, the
    more of them noise may have doubled.
    """

    def __init__(
        self,
        protocol: Protocol,
        conclude: Callable[..., None],
        *,
        lossless: bool = False,
        frames: Callable[[], int] = lambda: 0,
    ) -> None:
        self._frames = frames
        self._protocol = protocol
        self._lossless = lossless
        self._conclude = conclude
        self._strays: list[tuple[Answers, str]] = []
        self._stray = False
        self._lost = 0

    def unexpected(self, answers: Iterable[tuple[int, int]], reason: str) -> None:
        """Record answers, as (time in ns, code), that no instruction asked for."""
        came = tuple(answers)
        self._strays.append((came, reason))
        many = len(self._strays) >= _SEVERAL + _NOISE * self._frames()
        if self._lossless or many or len(came) >= _STRAYS:
            self._end_strays(Verdict.FAIL)

    def missing(self, count: int) -> None:
        """Record `count` unanswered instructions of a device that went on answering."""
        self._lost += count

    def silent(self, reason: str) -> None:
        """Report that the device stopped answering: a failure."""
        self._lost = 0
        self._silence(Verdict.FAIL, reason)

    def close(self, *, keeps_all: bool) -> None:
        """Report at the run's end what was recorded, as inconclusive.

        Missing answers count only if the device `keeps_all`, that is takes each instruction
        regardless of what preceded it; any other may discard what follows a fault.
        """
        if self._strays:
            self._end_strays(Verdict.INCONCLUSIVE)
        if self._lost and keeps_all:
            times = "once" if self._lost == 1 else f"{self._lost} times"
            reason = f"no answer came {times} where no case was judged"
            if self._lossless:
                self._silence(Verdict.FAIL, f"{reason}, on a line that loses nothing")
            else:
                self._silence(Verdict.INCONCLUSIVE, f"flaky: {reason}")

    def _silence(self, verdict: Verdict, reason: str) -> None:
        case = case_of_the_run(self._protocol, "line/lost")
        axis = Axis(verdict, "each instruction answered once", "no answer", reason)
        self._conclude(case, {"answer": axis}, certain=True)

    def _end_strays(self, verdict: Verdict) -> None:
        if self._stray:
            return
        self._stray = True
        came = tuple(answer for answers, _ in self._strays for answer in answers)
        reason = self._strays[-1][1]
        if self._lossless and len(came) < _STRAYS:
            reason = f"{reason}, on a line that loses nothing"
        if verdict is not Verdict.FAIL:
            times = "once" if len(self._strays) == 1 else f"{len(self._strays)} times"
            reason = f"flaky, only {times} in the run: {reason}"
        words = answer_words(self._protocol, tuple(code for _, code in came))
        axis = Axis(verdict, "no answer", words, reason, "R-unsolicited")
        case = case_of_the_run(self._protocol, "line/unsolicited")
        self._conclude(case, {"answer": axis}, came, came[0][0])
