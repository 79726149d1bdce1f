"""A trial that failed is repeated until noise does not explain it; else its failure is flaky."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bilprov.analyzer.client.operations import Procedure, drive, listen
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.runner.noise import Confirmed, confirm
from bilprov.conformance.runner.run import Run, RunConfig
from bilprov.spec.protocol import Protocol
from tests.support.robots import ALL_SEEING, CountingLink, Timers

FAILED = Axis(Verdict.FAIL, "0", "1", "answered 1")


def run_of(protocol: Protocol, *, lossless: bool = False) -> Run:
    return Run(RunConfig(protocol, Timers(), ALL_SEEING, lossless=lossless))


def confirmed(run: Run, outcomes: str) -> Confirmed:
    """What is found where the tries fail (x) or not (.) in this order."""
    left: Iterator[str] = iter(outcomes)

    def fails() -> Procedure[bool]:
        yield from listen(None, 0)
        return next(left) == "x"

    found: list[Confirmed] = []

    def procedure() -> Procedure[None]:
        found.append((yield from confirm(run, 20, fails)))

    drive(procedure(), CountingLink(Simulator(run.protocol)), lambda: False)
    return found[0]


@pytest.mark.parametrize(
    ("outcomes", "expected"),
    [
        ("xxx", Confirmed(True, 3, 3)),
        ("xx.x", Confirmed(True, 4, 3)),
        ("...", Confirmed(False, 3, 0)),
        ("x..", Confirmed(False, 3, 1)),
        ("xx..", Confirmed(False, 4, 2)),
    ],
)
def test_a_trial_is_repeated_until_its_failures_are_no_noise_or_few(
    protocol: Protocol, outcomes: str, expected: Confirmed
) -> None:
    assert confirmed(run_of(protocol), outcomes) == expected


def test_on_a_line_that_was_flaky_before_more_failures_are_needed(protocol: Protocol) -> None:
    run = run_of(protocol)
    run.counters.flaky, run.answers = 20, 2000

    assert confirmed(run, "xxxxxx") == Confirmed(True, 6, 6)


@pytest.mark.parametrize(
    ("lossless", "sure", "verdict", "reason"),
    [
        (False, True, Verdict.FAIL, "answered 1"),
        (False, False, Verdict.INCONCLUSIVE, "flaky, not reproduced in 3 tries: answered 1"),
        (
            True,
            False,
            Verdict.FAIL,
            "met 2 times in 4 tries, on a line that loses nothing: answered 1",
        ),
    ],
)
def test_only_a_lossless_line_keeps_a_failure_that_did_not_come_back(
    protocol: Protocol, lossless: bool, sure: bool, verdict: Verdict, reason: str
) -> None:
    judged = Confirmed(sure, 3, 1).judged(run_of(protocol, lossless=lossless), FAILED)

    assert (judged.verdict, judged.reason) == (verdict, reason)
