"""Shards: each case is in exactly one, all take about as long, and the split is reproducible."""

from __future__ import annotations

from typing import Any

import pytest

from bilprov.analyzer.transport.line_settings import LineSettings, line_settings
from bilprov.conformance.api import Options, conform, estimated_seconds, run_suite, select_cases
from bilprov.conformance.cases.budget import Pace, before_the_cases, seconds
from bilprov.conformance.cases.opening import opening_cases
from bilprov.conformance.cases.selection import matching, shard_named, share
from bilprov.conformance.dut.link import Environment
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import Target
from bilprov.conformance.dut.virtual_link import VirtualLink
from bilprov.spec.protocol import Protocol
from tests.support.commands import command
from tests.support.robots import ALL_SEEING, sentence, served_here

OPENING = ("power-on/", "link/", "timing/", "reading/")  # what every run has


@pytest.mark.sample(8)
@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 4, 7])
@pytest.mark.parametrize("seed", [1, 9])
@pytest.mark.parametrize("only", [(), ("bad-data/*", "truncated/*/1")])
@pytest.mark.parametrize("level", ["smoke", "standard"])
def test_the_shards_are_disjoint_complete_and_in_order(
    protocol: Protocol, count: int, seed: int, only: tuple[str, ...], level: str
) -> None:
    options = Options(only=only, seed=seed, level=level)
    whole = select_cases(protocol, options)
    shards = [
        select_cases(protocol, Options(only=only, seed=seed, level=level, shard=(n, count)))
        for n in range(1, count + 1)
    ]

    place = {case.id: at for at, case in enumerate(whole)}
    assert sorted(place[case.id] for shard in shards for case in shard) == list(range(len(whole)))
    for shard in shards:
        assert [place[case.id] for case in shard] == sorted(place[case.id] for case in shard)


@pytest.mark.sample(2)
@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 4, 7, 16])
def test_no_shard_takes_longer_than_another_by_more_than_one_case(
    protocol: Protocol, count: int
) -> None:
    options = Options()
    whole = select_cases(protocol, options)
    longest = max(estimated_seconds(protocol, [case], options) for case in whole)

    times = [
        estimated_seconds(protocol, select_cases(protocol, Options(shard=(n, count))), options)
        for n in range(1, count + 1)
    ]

    assert max(times) - min(times) <= longest
    assert sum(times) == pytest.approx(estimated_seconds(protocol, whole, options))


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
@pytest.mark.parametrize("options", [Options(budget=15), Options(level="smoke", shard=(2, 3))])
def test_a_run_chooses_its_cases_by_the_line_that_it_has(
    protocol: Protocol, options: Options
) -> None:
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


def test_a_case_that_takes_longer_than_all_others_has_a_shard_of_its_own(
    protocol: Protocol,
) -> None:
    cases = select_cases(protocol, Options(only=("valid/LED/*",)))
    dear = cases[3]

    def seconds(case: object) -> float:
        return 100.0 if case is dear else 1.0

    shares = [share(cases, (n, 3), seconds) for n in (1, 2, 3)]

    assert (dear,) in shares
    assert sorted(len(cases) for cases in shares) == [1, 3, 4]


def test_more_shards_than_cases_leaves_some_empty(protocol: Protocol) -> None:
    options = [Options(only=("valid/Stop",), shard=(n, 3)) for n in (1, 2, 3)]

    sizes = [len(select_cases(protocol, option)) for option in options]

    assert sizes == [1, 0, 0]


def test_the_opening_cases_run_in_each_shard(protocol: Protocol) -> None:
    opening = {case.id for case in opening_cases(protocol)}

    for shard in ((1, 2), (2, 2)):
        options = Options(only=("truncated/LED/*", "valid/LED/*"), shard=shard)
        report = conform(grammar=protocol, options=options)
        assert opening - {r.id for r in report.results} <= {"timing/truncation-timeout"}


@pytest.mark.parametrize("shard", [(0, 2), (3, 2), (-1, 4)])
def test_a_shard_that_there_is_not_is_refused(protocol: Protocol, shard: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="no shard"):
        select_cases(protocol, Options(shard=shard))


@pytest.mark.parametrize(
    "text", ["0/4", "5/4", "4", "1/0", "a/b", "1/4/2", " 1/4", "-1/4", "١/٤", ""]
)
def test_what_names_no_shard_is_one_sentence(text: str) -> None:
    with pytest.raises(ValueError, match="write I/N"):
        shard_named(text)
    assert shard_named("3/4") == (3, 4)


def test_globs_and_whole_ids_choose_alike() -> None:
    fits = matching(["a/*", "b/1", "c/[12]"])

    assert [i for i in ("a/1/2", "b/1", "b/11", "c/2", "c/3", "a") if fits(i)] == [
        "a/1/2",
        "b/1",
        "c/2",
    ]
