"""One attempt at a test case: executes the case once and returns its result, unpublished."""

from __future__ import annotations

import re
from dataclasses import dataclass

from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.dut.operations import Procedure
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.runner.homing import home
from bilprov.conformance.runner.run import RunState
from bilprov.conformance.runner.sequence import run_sequence
from bilprov.conformance.runner.sequence_answers import Mismatch
from bilprov.conformance.runner.single_frame import try_case


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt at a case: its result, and the mismatch where a sequence failed."""

    result: CaseResult
    mismatch: Mismatch | None

    @property
    def failed(self) -> bool:
        """Whether the case failed in this attempt."""
        return self.result.verdict is Verdict.FAIL

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


def attempt(run: RunState, case: Case | SequenceCase) -> Procedure[Attempt]:
    """Execute a case once and home the line; late answers found while homing count against it."""
    run.trying = []
    mismatch = None
    if isinstance(case, SequenceCase):
        mismatch = yield from run_sequence(run, case)
    else:
        yield from try_case(run, case)
    yield from home(run)
    return Attempt(run.tried(case.id), mismatch)
