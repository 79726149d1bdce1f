"""Mutation score: what is caught, by which cases, at what cost, and which survivors could show."""

from __future__ import annotations

import msgspec
import pytest

from bilprov.conformance.mutation.score import Caught, Score, chosen_faults, score
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.protocol import Protocol
from tests.support.commands import command

pytestmark = pytest.mark.slow

FEW = ("ok-to-bad-data", "sent-ahead-merged", "echo", "never-moves", "no-stop-after-65536-faults")


def test_each_fault_is_caught_as_it_must_be_and_the_groups_that_fail_are_named(
    protocol: Protocol,
) -> None:
    few = score(protocol, chosen_faults(protocol, 0, FEW), at=["smoke"], most=2000)
    (level,) = few.levels
    missed = [name for name, result in few.at(level).items() if not result.caught]

    # An echo is an unusable line, and a robot that never moves is not vouched for.
    assert missed == list(few.soak) == ["no-stop-after-65536-faults"]
    assert few.reference == {level: "pass"}
    assert few.bytes[level] > 3000
    assert few.at(level)["ok-to-bad-data"].groups == ("bad-data", "sequence/tour")


@pytest.mark.slow
def test_a_survivor_that_can_show_fails_the_suite_and_is_shown(protocol: Protocol) -> None:
    # That value in that motion is no frame of smoke.
    name = "accepts-led-132-while-rotate-right"
    found = score(protocol, chosen_faults(protocol, 0, [name]), at=["smoke"], most=50_000)

    assert found.survivors("smoke") == [name]
    assert found.searches[name].shown
    assert found.failures == ["smoke: 0 of 1 named faults, 88% must be"]


def result(name: str, *groups: str, level: str = "x") -> Caught:
    return Caught(name, level, bool(groups), "fail" if groups else "pass", groups, True, 9)


def made(*results: Caught, **more: object) -> Score:
    faults = {r.name: ("random" if ":" in r.name else "family", "") for r in results}
    levels = tuple(dict.fromkeys(r.level for r in results))
    values: dict[str, object] = {
        "levels": levels, "bytes": {}, "faults": faults, "soak": (), "results": results,
        "reference": dict.fromkeys(levels, "pass"), "searches": {},
    }  # fmt: skip
    return Score(**(values | more))  # type: ignore[arg-type]


def test_what_a_group_catches_alone(protocol: Protocol) -> None:
    found = made(result("a", "one"), result("b", "one", "two"), result("c", "two"), result("d"))

    assert found.alone("x") == {"one": ["a"], "two": ["c"]}
    assert found.survivors("x") == ["d"]
    assert found.caught("family", "x") == (3, 4)


def test_a_random_fault_that_no_search_shows_does_not_count() -> None:
    from bilprov.conformance.mutation.search import Search

    unseen = Search()
    drawn = [result(f"random:{n}", "one") for n in range(9)]

    assert made(*drawn, result("random:9")).share("x", drawn=True) == (9, 10)
    assert made(*drawn, result("random:9")).failures == []
    two = (*drawn, result("random:9"), result("random:10"))
    assert made(*two).failures == ["x: 9 of 11 random faults, 90% must be"]
    assert made(*two, searches={"random:9": unseen}).share("x", drawn=True) == (9, 10)
    assert made(*two, searches={"random:9": unseen}).failures == []
    named = made(result("a", "one"), result("b"), searches={"b": unseen})
    assert named.share("x", drawn=False) == (1, 2)  # a named fault is meant to show


@pytest.mark.slow
def test_random_faults_count_where_they_can_be_told_apart(protocol: Protocol) -> None:
    # Failed; passed although a search shows it; a cut frame in two parts is no input of it.
    few = ["random:1.27", "random:1.52", "random:1.60"]
    found = score(protocol, chosen_faults(protocol, 60, few, fault_seed=1), at=["smoke"], most=4000)

    verdicts = {name: one.verdict for name, one in found.at("smoke").items()}
    assert verdicts == {"random:1.27": "pass", "random:1.52": "fail", "random:1.60": "pass"}
    assert (found.failed, found.told_apart, found.passed, found.inconclusive) == (1, 2, 1, 0)
    assert found.searches["random:1.27"].shown
    assert not found.searches["random:1.60"].shown


def test_each_level_has_its_floor_and_the_reference_must_pass() -> None:
    smoke = [result(str(n), *["g"][: n < 8], level="smoke") for n in range(9)]

    assert made(*smoke).failures == []
    assert made(*smoke[1:], result("z", level="smoke")).failures == [
        "smoke: 7 of 9 named faults, 88% must be"
    ]
    assert made(result("a"), soak=("a",)).failures == []
    broken = made(result("a", "g"), reference={"x": Verdict.FAIL.label})
    assert broken.failures == ["x: the reference device gets fail"]
    astray = made(msgspec.structs.replace(result("a", "g"), own_clause=False))
    assert astray.failures == ["x: no case that fails for a names its clause"]


@pytest.mark.slow
def test_the_choice_of_faults(protocol: Protocol) -> None:
    assert len(chosen_faults(protocol, 0)) > 300
    assert list(chosen_faults(protocol, 2, ["random:*"])) == ["random:1", "random:2"]
    assert chosen_faults(protocol, 1, ["nothing"]) == {}
    assert list(chosen_faults(protocol, 1, ["r*"], fault_seed=7)) == ["random:7.1"]


def test_the_command_scores_on_several_processes_and_writes_json() -> None:
    words = [word for name in ("ok-to-bad-data", "echo", "random:1") for word in ("--only", name)]
    words += ("--random", "1", "--level", "smoke")
    result = command("lab", "score", *words, "--jobs", "2", "--json", "-")

    told = msgspec.json.decode(result.stdout, type=Score)
    assert [r.name for r in told.results] == ["ok-to-bad-data", "echo", "random:1"]
    assert result.returncode == (1 if told.failures else 0)
    assert b"bytes sent" in result.stderr


def test_the_command_prints_the_rate_that_counts() -> None:
    words = ("--only", "random:1.52", "--random", "60", "--fault-seed", "1", "--level", "smoke")
    result = command("lab", "score", *words, "--json", "-")

    assert b"smoke: failed 1 of 1 that can be told apart, 100.0 %" in result.stderr
