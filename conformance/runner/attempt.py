"""One attempt at a test case: executes the case once, homes the line and returns the result."""

from __future__ import annotations

import re
from dataclasses import dataclass

from bilprov.analyzer.client.operations import Ended, Procedure
from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.cases.wheel_order import OrderCase
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.runner.homing import home_after
from bilprov.conformance.runner.run import Run
from bilprov.conformance.runner.sequence import run_sequence
from bilprov.conformance.runner.sequence_answers import Mismatch
from bilprov.conformance.runner.single_frame import run_single_frame
from bilprov.conformance.runner.trial import Homed, Trial
from bilprov.conformance.runner.waiting import GaveUp
from bilprov.conformance.runner.wheel_order import run_wheel_order


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt at a case: its result, and the mismatch where a sequence failed.

    `stopped` is what ended the run, or why it is to be ended, None if nothing. `looks`
    is how many looks were made in it. `already` is how the state that failed was wrong before the
    frame under test, "" if it was not.
    """

    result: CaseResult
    mismatch: Mismatch | None = None
    stopped: Ended | GaveUp | None = None
    looks: int = 0
    already: str = ""

    @property
    def failed(self) -> bool:
        """Whether the case failed in this attempt."""
        return self.result.verdict is Verdict.FAIL

    @property
    def held_up(self) -> bool:
        """Whether line or device stood still for a moment where it failed."""
        return self.mismatch is not None and self.mismatch.held_up

    @property
    def axis(self) -> str:
        """The axis that failed."""
        return self.how.partition(":")[0]

    @property
    def how(self) -> str:
        """How it failed: the worst axis and its reason, with each number as #."""
        name, axis = max(self.result.axes.items(), key=lambda item: item[1].verdict)
        return f"{name}: {re.sub(r'[0-9]+', '#', axis.reason)}"

    @property
    def where(self) -> tuple[int, str]:
        """Where and how it failed: the burst's index (0 for a single frame), and `how`."""
        return (self.mismatch.burst if self.mismatch else 0), self.how


def attempt(run: Run, case: Case | SequenceCase) -> Procedure[Attempt]:
    """Attempt a case once: preamble, stimulus, checks, then homing, which shows late answers too.

    An attempt that was stopped, by the user, the link or the device, has a result too: what passed
    so far is then no pass.
    """
    trial, mismatch = Trial(run, case), None
    looks = run.looks.made
    try:
        if isinstance(case, SequenceCase):
            mismatch = yield from run_sequence(trial, case)
        elif isinstance(case, OrderCase):
            yield from run_wheel_order(trial, case)
        else:
            yield from run_single_frame(trial, case)
    except Ended as ended:
        homed = Homed(stopped=ended)
    else:
        homed = yield from home_after(run, trial)
    result = trial.end(homed)
    return Attempt(result, mismatch, homed.stopped, run.looks.made - looks, trial.already)
