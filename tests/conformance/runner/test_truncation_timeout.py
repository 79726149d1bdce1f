"""The truncation time-out: measured by answers and stops, whatever else the device chooses."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bilprov.analyzer.client.operations import drive
from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.variants import variants
from bilprov.conformance.oracle.profile import Timers
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.runner.executor import Runner
from bilprov.conformance.runner.run import Run, RunConfig
from bilprov.spec.protocol import Protocol
from tests.support.faults import watchdog
from tests.support.pairs import pairs
from tests.support.robots import ALL_SEEING, MS, CountingLink

WATCHDOG = Fault("", "", "", react=watchdog(1000))


def measured(protocol: Protocol, fault: Fault) -> tuple[Run, CaseResult]:
    """A run that only finds out what the device chooses, and its result for the time-out."""
    run = Run(RunConfig(protocol, Timers(idle=2500 * MS), ALL_SEEING))
    drive(Runner(run, []).execute(), CountingLink(Simulator(protocol, fault)), lambda: False)
    return run, next(result for result in run.results if result.id == "timing/truncation-timeout")


def test_a_short_time_out_that_only_the_stop_shows_is_not_taken_for_a_longer_one(
    protocol: Protocol,
) -> None:
    name = "R-truncated-known=silent-and-others-answered and R-truncation-timeout=3-ms"
    run, _ = measured(protocol, pairs(protocol)[name])

    assert run.profile.truncation_timeout is not None
    assert 3 * MS <= run.profile.truncation_timeout < 5 * MS
    assert max(result.verdict for result in run.results) < Verdict.INCONCLUSIVE


def test_the_stop_of_a_watchdog_is_not_that_of_the_time_out(protocol: Protocol) -> None:
    run, result = measured(protocol, replace(WATCHDOG, timeout=1500 * MS))

    assert run.profile.truncation_timeout == 1500 * MS
    assert result.verdict is Verdict.NON_STRICT  # for the time alone: its answer came at once
    assert set(result.axes) == {"answer", "state"}
    assert result.axes["answer"].verdict is Verdict.PASS
    assert max(result.verdict for result in run.results) < Verdict.INCONCLUSIVE


def test_a_stop_at_the_time_out_counts_although_the_answer_comes_later(
    protocol: Protocol,
) -> None:
    name = "R-answer-deadline=150-ms-after-faults"
    run, _ = measured(protocol, variants(protocol)[name].fault)

    assert run.profile.truncation_timeout is not None
    assert 50 * MS <= run.profile.truncation_timeout < 60 * MS


def test_a_time_out_that_never_comes_is_no_pass_where_a_watchdog_stops_the_robot(
    protocol: Protocol,
) -> None:
    _, result = measured(protocol, replace(WATCHDOG, timeout=None))

    assert result.verdict is Verdict.INCONCLUSIVE
    assert "hides the time-out" in result.axes["stop"].reason


@pytest.mark.parametrize(
    ("other", "word"),
    [
        ("R-answer-deadline=one-at-a-time", "whole-frame"),
        ("R-truncated-known=silent", "whole-frame"),
        ("R-truncated-long=too-many", "whole-frame"),
        ("", "between-bytes"),
    ],
)
def test_what_the_time_out_counts_over_is_told_however_the_device_answers(
    protocol: Protocol, other: str, word: str
) -> None:
    whole = "R-truncation-timeout=whole-frame"
    names = {f"{whole} and {other}", f"{other} and {whole}"}
    both = {**pairs(protocol), "between": variants(protocol)["R-answer-deadline=60-ms"].fault}
    (name,) = names & both.keys() or {"between"}
    run, _ = measured(protocol, both[name])

    assert run.profile.choices.word("R-truncation-timeout") == word
