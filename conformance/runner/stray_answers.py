"""What happens on the line between the cases and is nobody's: answers too many, and too few."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from conformance.cases.single_frames import Case, special
from conformance.oracle.judge import answer_words
from conformance.oracle.verdicts import Axis, Verdict
from spec.protocol import Protocol

Answers = tuple[tuple[int, int], ...]
End = Callable[[Case, dict[str, Axis], Answers, int], None]

_STRAYS = 3  # answers that are nobody's, until they are the device's and not the line's


class Between:
    """Books of what no case is charged with. `end` is called with a case, its axes and answers.

    A byte that came or got lost once may be the line's: no failure, and no pass. A flood, or what
    comes again and again, is the device's, and so is a silence without end.
    """

    def __init__(self, protocol: Protocol, end: End) -> None:
        self._protocol = protocol
        self._end = end
        self._strays: list[tuple[Answers, str]] = []
        self._stray = False
        self._lost = 0

    def came(self, answers: Iterable[tuple[int, int]], reason: str) -> None:
        """Answers that nobody asked for."""
        came = tuple(answers)
        self._strays.append((came, reason))
        if len(self._strays) >= _STRAYS or len(came) >= _STRAYS:
            self._end_strays(Verdict.FAIL)

    def lost(self, count: int) -> None:
        """So many instructions were not answered, and the device went on answering."""
        self._lost += count

    def silent(self, reason: str) -> None:
        """The device stopped answering."""
        self._lost = 0
        self._silence(Verdict.FAIL, reason)

    def close(self, *, keeps_all: bool) -> None:
        """The run is over; `keeps_all` if the device takes each instruction, whatever came before.

        One that does not may have lost what was sent behind a fault.
        """
        if self._strays:
            self._end_strays(Verdict.INCONCLUSIVE)
        if self._lost and keeps_all:
            times = "once" if self._lost == 1 else f"{self._lost} times"
            reason = f"flaky: no answer came {times} where no case was judged"
            self._silence(Verdict.INCONCLUSIVE, reason)

    def _silence(self, verdict: Verdict, reason: str) -> None:
        clause, requirement = self._protocol.clauses.responses, "answers between the cases too"
        case = special(self._protocol, "line/lost", clause, requirement, b"")
        axis = Axis(verdict, "each instruction answered once", "no answer", reason)
        self._end(case, {"answer": axis}, (), 0)

    def _end_strays(self, verdict: Verdict) -> None:
        if self._stray:
            return
        self._stray = True
        came = tuple(answer for answers, _ in self._strays for answer in answers)
        reason = self._strays[-1][1]
        if verdict is not Verdict.FAIL:
            times = "once" if len(self._strays) == 1 else f"{len(self._strays)} times"
            reason = f"flaky, only {times} in the run: {reason}"
        words = answer_words(self._protocol, tuple(code for _, code in came))
        axis = Axis(verdict, "no answer", words, reason, "R-unsolicited")
        clause, requirement = self._protocol.clauses.responses, "answers only when it is asked"
        case = special(self._protocol, "line/unsolicited", clause, requirement, b"")
        self._end(case, {"answer": axis}, came, came[0][0])
