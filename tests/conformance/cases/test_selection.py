"""Which cases a run has, and how long they take on the line that it has."""

from __future__ import annotations

from typing import Any

import pytest

from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.conformance.api import Options, select_cases
from bilprov.conformance.cases.budget import Pace, before_the_cases, seconds
from bilprov.conformance.cases.levels import matching
from bilprov.conformance.dut.simulator import Simulator
from bilprov.spec.protocol import Protocol
from tests.support.commands import command
from tests.support.robots import sentence, served_here

OPENING = ("power-on/", "link/", "timing/", "reading/")  # what every run has


def test_the_cases_take_longer_on_a_slower_line(protocol: Protocol) -> None:
    options = Options(level="smoke")
    cases = select_cases(protocol, options)

    def told(*line: Any) -> float:
        pace = Pace(protocol.timing.truncation_timeout / 1000, LineSettings(*line).byte_time / 1e9)
        return sum(seconds(protocol, case, pace) for case in cases)

    assert told(9600, "E", 2) > told(9600, "N", 1) > told(115_200, "N", 1)
    # What is not wire takes the same everywhere.
    halved = told(2400, "N", 1) - told(4800, "N", 1)
    assert halved == pytest.approx(2 * (told(4800, "N", 1) - told(9600, "N", 1)))


@pytest.mark.waits
def test_the_line_that_is_given_is_announced_and_its_cases_are_listed(protocol: Protocol) -> None:
    options = Options(level="smoke")
    cases = select_cases(protocol, options)
    given = ("--level", "smoke", *("--baud", "2400", "--parity", "E"))

    with served_here(Simulator(protocol), pty=True) as (port, _):
        refused = command("conform", port, *given, "--stopbits", "2")
    listed = command("conform", "/dev/nowhere", *given, "--stopbits", "2", "--list")

    # On a pty no byte takes time.
    pace = Pace(protocol.timing.truncation_timeout / 1000, few_looks=True)
    said = before_the_cases(pace) + sum(seconds(protocol, case, pace) for case in cases)
    assert f"for about {said:.0f} s" in sentence(refused)
    ids = [row.split()[0] for row in listed.stdout.decode().splitlines()]
    assert [ident for ident in ids if not ident.startswith(OPENING)] == [c.id for c in cases]


def test_globs_and_whole_ids_choose_alike() -> None:
    fits = matching(["a/*", "b/1", "c/[12]"])

    assert [i for i in ("a/1/2", "b/1", "b/11", "c/2", "c/3", "a") if fits(i)] == [
        "a/1/2",
        "b/1",
        "c/2",
    ]
