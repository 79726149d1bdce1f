"""The test cases of the suite as pytest items: the verdict is the outcome, evidence the message."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NoReturn

import pytest

from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.pytest_plugin.bench import SuiteThread
from bilprov.conformance.report.run_report import evidence, reproducer

NAME = "conformance"


class Conformance(pytest.Collector):
    """The suite as a collector without a file, whose items are the cases."""

    bench: SuiteThread
    ids: Sequence[str]

    @classmethod
    def of(cls, session: pytest.Session, bench: SuiteThread, ids: Sequence[str]) -> Conformance:
        """The suite with these cases."""
        suite: Conformance = cls.from_parent(session, name=NAME, nodeid=NAME)
        suite.bench, suite.ids = bench, ids
        suite.add_marker(NAME)
        return suite

    def collect(self) -> Iterable[pytest.Item]:
        """The cases, in the run's order."""
        for ident in self.ids:
            yield CaseItem.from_parent(self, name=ident)


class CaseItem(pytest.Item):
    """One case as an item. `known` is true for one that was not collected but has a result."""

    known = False
    parent: Conformance

    def setup(self) -> None:
        """Wait for the result; a case that the kit could not judge is an error, not a failure."""
        bench = self.parent.bench
        result = bench.result(self.name)
        if result is None:
            why = bench.why_not(self.name)
            if bench.told_why or not why:
                _skip(f"not judged: {why or 'this run did not need it'}")
            bench.told_why = True  # said once: the reason is the same for all that are left
            _fail(f"not judged: {why}")
        self._result = result
        self.user_properties += [("clause", result.clause), ("verdict", result.verdict.label)]
        if result.reading:
            self.user_properties.append(("reading", result.reading))
        if result.verdict is Verdict.ERROR:
            _fail(result.reason)

    def runtest(self) -> None:
        """The verdict as an outcome: only `fail` fails, only what was judged passes."""
        result = self._result
        if result.verdict is Verdict.FAIL:
            _fail(self._evidence(result))
        if result.verdict in (Verdict.INCONCLUSIVE, Verdict.SKIPPED):
            _skip(f"{result.verdict.label}: {result.reason}")
        if result.verdict is not Verdict.PASS:
            self.add_report_section("call", NAME, f"{result.verdict.label}: {result.reason}")

    def reportinfo(self) -> tuple[Path, int, str]:
        """The location that pytest shows: a path made of the suite's name, which has no file."""
        return self.config.rootpath / NAME, 0, self.name

    def _evidence(self, result: CaseResult) -> str:
        bench = self.parent.bench
        command = reproducer(
            bench.protocol.origin, bench.target, bench.environment.link, bench.options
        )
        rows = [*evidence(result), ("reproduce", command(result))]
        lines = [f"{label:10}{words}" for label, words in rows]
        return "\n".join([f"{result.id} ({result.clause}): {result.requirement}", *lines])


def _fail(message: str) -> NoReturn:
    """Fail with the message alone: a traceback into the kit would not help the user."""
    pytest.fail(message, pytrace=False)


def _skip(reason: str) -> NoReturn:
    raise pytest.skip.Exception(reason, _use_item_location=True)
