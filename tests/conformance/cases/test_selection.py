"""Which cases a run has, and how long they take on the line that it has."""

from __future__ import annotations

from typing import Any

import pytest

from bilprov.analyzer.transport.line_settings import LineSettings, line_settings
from bilprov.conformance.api import Options, estimated_seconds, run_suite, select_cases
from bilprov.conformance.cases.budget import Pace, before_the_cases, seconds
from bilprov.conformance.cases.selection import matching
from bilprov.conformance.dut.link import Environment
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import Target
from bilprov.conformance.dut.virtual_link import VirtualLink
from bilprov.spec.protocol import Protocol
from tests.support.commands import command
from tests.support.robots import ALL_SEEING, sentence, served_here

OPENING = ("power-on/", "link/", "timing/", "reading/")  # what every run has


def test_the_cases_take_longer_on_a_slower_line(protocol: Protocol) -> None:
    options = Options(level="smoke")
    cases = select_cases(protocol, options)

    def told(*line: Any) -> float:
        return estimated_seconds(protocol, cases, options, LineSettings(*line))

    own = line_settings(protocol, None, None, None)
    assert told(own.baud, own.parity, own.stopbits) == estimated_seconds(protocol, cases, options)
    assert told(9600, "E", 2) > told(9600, "N", 1) > estimated_seconds(protocol, cases, options)
    # What is not wire takes the same everywhere.
    halved = told(2400, "N", 1) - told(4800, "N", 1)
    assert halved == pytest.approx(2 * (told(4800, "N", 1) - told(9600, "N", 1)))


@pytest.mark.slow
def test_a_budget_holds_on_the_line_that_is_given(protocol: Protocol) -> None:
    options, line = Options(budget=20), LineSettings(2400, "N", 1)

    chosen = select_cases(protocol, options, line)

    assert 0 < estimated_seconds(protocol, chosen, options, line) <= 20
    assert len(chosen) < len(select_cases(protocol, options))


@pytest.mark.slow
def test_a_run_chooses_its_cases_by_the_line_that_it_has(protocol: Protocol) -> None:
    options = Options(budget=15)
    line = LineSettings(1200, "E", 2)
    link = {"kind": "port", "line": str(line)}

    target = Target(
        protocol,
        Environment(virtual=True, observability=ALL_SEEING, power=True, device="x", link=link),
        connect=lambda listener: VirtualLink(Simulator(protocol), line.byte_time, listener),
    )
    report = run_suite(target, options)

    chosen = [case.id for case in select_cases(protocol, options, line)]
    assert chosen != [case.id for case in select_cases(protocol, options)]
    judged = [r.id for r in report.results if not r.id.startswith((*OPENING, "level/left-out"))]
    assert judged == chosen


@pytest.mark.waits
def test_the_line_that_is_given_is_announced_and_its_cases_are_listed(protocol: Protocol) -> None:
    options, line = Options(level="smoke", budget=15), LineSettings(2400, "E", 2)
    cases = select_cases(protocol, options, line)
    given = ("--level", "smoke", "--budget", "15", *("--baud", "2400", "--parity", "E"))

    with served_here(Simulator(protocol), pty=True) as (port, _):
        refused = command("conform", port, *given, "--stopbits", "2")
    listed = command("conform", "/dev/nowhere", *given, "--stopbits", "2", "--list")

    # The line's settings choose the cases; on a pty no byte takes time.
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
