"""Shards: every case in exactly one, all about as long, the same ones every time."""

from __future__ import annotations

import msgspec
import pytest

from conformance.api import Options, conform, estimated_seconds, select_cases
from conformance.cases.opening import opening_cases
from conformance.cases.selection import matching, shard_named, share
from spec.protocol import Protocol
from tests.robots import command, sentence


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


def test_the_command_says_its_shard_and_refuses_nonsense() -> None:
    good = command("conform", "sim", "--only", "valid/LED/*", "--shard", "2/2", "--json", "-")
    wrong = command("conform", "sim", "--shard", "3/2")
    listed = [
        command("conform", "sim", "--only", "valid/LED/*", "--shard", f"{n}/2", "--list").stdout
        for n in (1, 2)
    ]

    report = msgspec.json.decode(good.stdout)
    ran = {case["id"] for case in report["cases"] if case["id"].startswith("valid/LED")}
    assert report["options"]["shard"] == [2, 2]
    assert len(ran) == 4
    assert b"(shard 2 of 2)" in good.stderr
    assert all(case.encode() in listed[1] and case.encode() not in listed[0] for case in ran)
    assert wrong.returncode == 2
    assert "write I/N" in sentence(wrong)


def test_globs_and_whole_ids_choose_alike() -> None:
    fits = matching(["a/*", "b/1", "c/[12]"])

    assert [i for i in ("a/1/2", "b/1", "b/11", "c/2", "c/3", "a") if fits(i)] == [
        "a/1/2",
        "b/1",
        "c/2",
    ]
