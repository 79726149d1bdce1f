"""The bank of faulty devices: the suite fails each of them, in the cases that the fault names."""

from __future__ import annotations

from dataclasses import fields

import pytest

from bilprov.conformance.api import Options, suite_ids
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import all_faults, fault_bank
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.fields import Clauses
from bilprov.spec.protocol import Protocol, load
from tests.support import ROOT
from tests.support.robots import CountingLink, at_rest, cases_of, failing, matching, run_over

# xdist must collect the same tests everywhere: the names come from the kit's own grammar.
BANK = fault_bank(load((ROOT / "spec" / "grammar.py").read_text(encoding="utf-8"), "grammar.py"))

# What each of these breaks, typed by hand: all of these cases fail, and no other.
EXACTLY = {
    "ok-to-unknown-id": ["unused-id/*", "recovery/unused-id/*", "link/unused-id"],
    "ok-to-too-many": ["wrong-length/*/[1-9]", "wrong-length/*/1?", "recovery/too-many/*"],
    "wrong-code-for-truncated": ["truncated/*", "recovery/truncated/*", "timing/truncation-*"],
    "no-stop-on-bad-data": ["bad-data/*", "recovery/bad-data/*"],
    "accepts-id-15": ["unused-id/15/*", "truncated/15/*"],
    "accepts-led-bit-3": ["bad-data/LED/[89]", "bad-data/LED/1[0-5]", "recovery/bad-data/*"],
    "swallows-missing-data": ["wrong-length/[SRL][!t]*/0"],
    "stop-does-nothing": ["valid/Stop", "leave/stopped"],
}
# Devices of which too little is left to judge one by one: what else they break is not said.
SWEEPING = {
    "always-1",
    "answers-at-header",
    "double-answer",
    "nibbles-swapped",
    "sticks-after-50-faults",
    "unused-code-for-valid",
    "xon-xoff",
}

# What a case's id begins with where single frames are the case.
SINGLE = (*FrameClass, "link", "line", "timing", "leave")


def by_single_frames(fault: Fault) -> bool:
    """Whether single frames are meant to catch it, and nothing else is."""
    return all(glob == "*" or glob.split("/")[0] in SINGLE for glob in fault.caught_by)


def test_every_fault_says_what_it_does_and_which_clauses_it_breaks(protocol: Protocol) -> None:
    bank = fault_bank(protocol)

    assert len({fault.doc for fault in bank.values()}) == len(bank)
    for name, fault in bank.items():
        assert name == fault.name
        assert {*fault.clauses} <= {field.name for field in fields(Clauses)}, name
        assert fault.clauses, name


def test_no_two_faults_have_one_name(protocol: Protocol, horn: Protocol) -> None:
    for grammar in (protocol, horn):
        names = [fault.name for fault in all_faults(grammar)]
        assert len(names) == len(set(names))


def test_only_a_broken_line_ends_in_2_and_only_no_motion_at_all_in_3(protocol: Protocol) -> None:
    exits = {name: fault.exit for name, fault in fault_bank(protocol).items() if fault.exit != 1}

    assert exits == {"echo": 2, "dead": 2, "never-moves": 3}


def test_a_fault_that_fails_says_which_cases_catch_it(protocol: Protocol) -> None:
    for name, fault in fault_bank(protocol).items():
        assert bool(fault.caught_by) is (fault.exit == 1), name
        assert ("*" in fault.caught_by) is (name in SWEEPING), name


@pytest.mark.sample(0)
@pytest.mark.slow
def test_every_glob_that_a_fault_names_has_cases(protocol: Protocol) -> None:
    suite = suite_ids(protocol, Options(level="deep", soak=1))  # the ids of the others, and more
    globs = {glob for fault in fault_bank(protocol).values() for glob in fault.caught_by}

    assert {glob for glob in globs if not any(matching(ident, (glob,)) for ident in suite)} == set()


@pytest.mark.sample(6)
@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n, fault in BANK.items() if by_single_frames(fault)])
def test_a_fault_fails_the_cases_that_are_meant_to_catch_it(protocol: Protocol, name: str) -> None:
    fault = fault_bank(protocol)[name]
    device = Simulator(protocol, fault)
    cases = cases_of(protocol)

    runner = run_over(CountingLink(device), protocol, cases)

    results = runner.run.results
    found = failing(results)
    assert bool(runner.unusable) is (results == []) is (fault.exit == 2)
    assert Verdict.ERROR not in {result.verdict for result in results}
    assert {ident for ident in found if not matching(ident, fault.caught_by)} == set()
    ids = {case.id for case in cases} if results else set()
    tried = [glob for glob in fault.caught_by if any(matching(i, (glob,)) for i in ids)]
    assert [glob for glob in tried if not any(matching(i, (glob,)) for i in found)] == []
    assert sorted(result.id for result in results if result.id in ids) == sorted(ids)
    if name in EXACTLY:
        all_ids = (result.id for result in results)
        assert found == {ident for ident in all_ids if matching(ident, EXACTLY[name])}
    assert at_rest(device) or name in ("stop-does-nothing", "restarts-by-itself")


@pytest.mark.slow
def test_the_reference_passes_every_single_frame_there_is(protocol: Protocol) -> None:
    cases = cases_of(protocol, every_cut=True)
    runner = run_over(CountingLink(Simulator(protocol)), protocol, cases)

    # 781 valid, 112 unused, 135 wrong lengths, 248 bad data, 1,920 cuts, and 20 of recovery
    assert len(cases) == 781 + 112 + 135 + 248 + 1920 + 20
    # Without a power switch there is no second power-on.
    odd = [r.id for r in runner.run.results if r.verdict is not Verdict.PASS]
    assert odd == ["power-on/Forward"]
