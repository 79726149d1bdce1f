"""A case of the suite as a pytest test: its verdict is the outcome, its evidence the message."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NoReturn

import pytest

from captures.errors import shown
from conformance.oracle.profile import Profile
from conformance.oracle.verdicts import CaseResult, Verdict
from conformance.pytest_plugin.bench import Bench
from conformance.report.run_report import evidence, make_report, reproduce

NAME = "conformance"


class Conformance(pytest.Collector):
    """The suite: a node without a file, whose tests are the cases."""

    bench: Bench
    ids: Sequence[str]

    @classmethod
    def of(cls, session: pytest.Session, bench: Bench, ids: Sequence[str]) -> Conformance:
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
    """One case. `known` says that its result is there already, outside of the collection."""

    known = False
    parent: Conformance

    def setup(self) -> None:
        """Wait for the result; a case that the kit could not judge is an error, no failure."""
        bench = self.parent.bench
        result = bench.result(self.name)
        if result is None:
            why = bench.why_not(self.name)
            if bench.told_why or not why:
                _skip(f"not judged: {shown(why) or 'this run did not need it'}")
            bench.told_why = True  # once is enough: it is the same for all that are left
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
            _skip(f"{result.verdict.label}: {shown(result.reason)}")
        if result.verdict is not Verdict.PASS:
            self.add_report_section("call", NAME, f"{result.verdict.label}: {shown(result.reason)}")

    def reportinfo(self) -> tuple[Path, int, str]:
        """Where it is said to be: the suite has no file."""
        return self.config.rootpath / NAME, 0, self.name

    def _evidence(self, result: CaseResult) -> str:
        bench = self.parent.bench
        nothing = make_report(
            bench.protocol,
            (),
            (),
            Profile(),
            device=bench.target,
            link=bench.device,
            options=asdict(bench.options),
            seed=bench.options.seed,
        )
        rows = [*evidence(result), ("reproduce", reproduce(nothing, result))]
        lines = [f"{label:10}{shown(words)}" for label, words in rows]
        return "\n".join([f"{result.id} ({result.clause}): {result.requirement}", *lines])


def _fail(message: str) -> NoReturn:
    """Where in the kit it was raised says nothing: the message alone is shown."""
    pytest.fail(message, pytrace=False)


def _skip(reason: str) -> NoReturn:
    raise pytest.skip.Exception(reason, _use_item_location=True)
