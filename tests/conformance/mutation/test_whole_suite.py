"""The whole suite against the whole bank: each fault gives its exit code, for its own clause.

The rest of a run is skipped once a failed case names a clause that the fault breaks.
"""

from __future__ import annotations

from collections.abc import Sequence
from random import Random

import pytest

from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import device_target
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.mutation.mixtures import mixtures
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.executor import SkipPolicy
from bilprov.spec.protocol import Protocol, load
from tests.support import ROOT

# xdist must collect the same tests everywhere: the names come from the kit's own grammar.
_OWN = load((ROOT / "spec" / "grammar.py").read_text(encoding="utf-8"), "grammar.py")
BANK = fault_bank(_OWN)
SOAK = [name for name, fault in BANK.items() if fault.needs == "soak"]
NAMED = [name for name in BANK if name not in SOAK]
_SMOKE_FLOOR = 0.88


def spare_after(clauses: set[str]) -> SkipPolicy:
    """Leaves out what comes after a case that failed and names one of the clauses."""
    read, done = 0, False

    def spare(ident: str, results: Sequence[CaseResult]) -> bool:
        nonlocal read, done
        for result in results[read:]:
            done = done or (result.verdict is Verdict.FAIL and result.clause in clauses)
        read = len(results)
        return done

    return spare


def run(protocol: Protocol, fault: Fault, **options: object) -> tuple[Report, set[str]]:
    """The report, and the clauses that failing cases name of those that the fault breaks."""
    broken = {getattr(protocol.clauses, name) for name in fault.clauses}
    report = run_suite(
        device_target(protocol, Simulator(protocol, fault)),
        Options(**options),  # type: ignore[arg-type]
        skip=spare_after(broken),
        logged=False,
    )
    failed = {r.clause for r in report.results if r.verdict is Verdict.FAIL}
    return report, failed & broken


@pytest.mark.sample(8)
@pytest.mark.slow
@pytest.mark.parametrize("name", NAMED)
def test_every_fault_ends_in_its_exit_code_and_names_what_it_breaks(
    name: str, protocol: Protocol
) -> None:
    fault = fault_bank(protocol)[name]
    report, named = run(protocol, fault)

    assert report.exit == fault.exit, report.verdict
    assert bool(named) is (fault.exit == 1)


@pytest.mark.sample(4)
@pytest.mark.slow
@pytest.mark.parametrize("name", mixtures(_OWN))
def test_every_mixture_of_two_readings_fails(name: str, protocol: Protocol) -> None:
    report, _ = run(protocol, mixtures(protocol)[name])

    assert report.exit == 1, report.verdict


@pytest.mark.slow
def test_smoke_catches_most_of_the_bank(protocol: Protocol, pytestconfig: pytest.Config) -> None:
    bank = fault_bank(protocol)
    draw = Random(pytestconfig.getoption("--sample-seed"))
    names = NAMED if pytestconfig.getoption("--whole") else draw.sample(NAMED, 60)
    caught = [
        name
        for name in names
        if run(protocol, bank[name], level="smoke")[0].exit == bank[name].exit
    ]

    assert len(caught) >= _SMOKE_FLOOR * len(names), len(caught)


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", SOAK)
def test_a_soak_catches_what_only_very_many_frames_show(name: str, protocol: Protocol) -> None:
    report, named = run(protocol, fault_bank(protocol)[name], level="smoke", soak=70_000)

    assert report.exit == 1
    assert named
