"""A trial that failed is repeated until noise does not explain it; else its failure is flaky."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bilprov.analyzer.client.operations import Procedure, drive, listen
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.runner.retry import Confirmed, confirm
from bilprov.conformance.runner.run import Run, RunConfig
from bilprov.spec.protocol import Protocol
from tests.support.robots import ALL_SEEING, CountingLink, Timers


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
