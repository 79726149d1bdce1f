"""Merged shards give the report of one run; a missing part never counts as a pass."""

from __future__ import annotations

from collections.abc import Callable
from io import StringIO
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rich.console import Console

from bilprov.conformance.api import Options, conform, select_cases
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.report.html.page import as_html
from bilprov.conformance.report.json_report import as_json, read_report
from bilprov.conformance.report.merge import (
    MergeError,
    ShardReport,
    merge,
    require_together,
    shard_from,
)
from bilprov.conformance.report.summary import show
from bilprov.spec.protocol import Protocol
from tests.support.commands import command, process
from tests.support.robots import simulate, unwell

ONLY = ("unused-id/9/?", "valid/LED/*", "bad-data/LED/1?", "truncated/LED/*")
Change = Callable[[dict[str, Any]], object]


def report_of(protocol: Protocol, fault: str, shard: tuple[int, int] | None) -> bytes:
    device = Simulator(protocol, fault_bank(protocol)[fault] if fault else None)
    options = Options(only=ONLY, shard=shard)
    return as_json(conform(device, grammar=protocol, options=options, fault=fault or None))


def shards(protocol: Protocol, fault: str = "", count: int = 3) -> list[bytes]:
    return [report_of(protocol, fault, (n, count)) for n in range(1, count + 1)]


def changed(data: bytes, change: Change) -> bytes:
    document = msgspec.json.decode(data)
    change(document)
    return msgspec.json.encode(document)


def merged(protocol: Protocol, *data: bytes) -> dict[str, Any]:
    parts = [shard_from(f"{n}.json", part) for n, part in enumerate(data)]
    require_together(parts, protocol)
    cases = select_cases(protocol, Options(only=ONLY))
    whole = merge(parts, protocol, cases)
    return msgspec.json.decode(whole.as_json(whole.report), type=dict[str, Any])


# -- as one run -----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["", "no-stop-on-bad-data", "led-order-reversed", "never-moves"])
@pytest.mark.parametrize("count", [1, 3])
def test_merged_shards_are_the_report_of_one_run(
    protocol: Protocol, fault: str, count: int
) -> None:
    whole = msgspec.json.decode(report_of(protocol, fault, None))

    found = merged(protocol, *reversed(shards(protocol, fault, count)))

    assert [case["id"] for case in found["cases"]] == [case["id"] for case in whole["cases"]]
    verdicts = {case["id"]: case["verdict"] for case in whole["cases"]}
    assert {case["id"]: case["verdict"] for case in found["cases"]} == verdicts
    for key in ("exit", "verdict", "counts", "coverage", "options", "seed", "grammar", "ended"):
        assert found[key] == whole[key], key
    assert [row["shard"] for row in found["shards"]] == [[n, count] for n in range(1, count + 1)]


def test_a_case_that_ran_in_several_takes_its_worst(protocol: Protocol) -> None:
    first, second, third = shards(protocol)

    def fail(document: dict[str, Any]) -> None:
        case = document["cases"][0]
        case["verdict"] = case["axes"]["state"]["verdict"] = "fail"

    found = merged(protocol, first, changed(second, fail), third)

    assert found["cases"][0]["id"] == "power-on/at-rest"
    assert [case["verdict"] for case in found["cases"]].count("fail") == 1
    assert (found["cases"][0]["verdict"], found["verdict"], found["exit"]) == ("fail", "fail", 1)


def test_what_a_later_kit_says_more_is_kept(protocol: Protocol) -> None:
    data = shards(protocol, count=2)

    def more(number: int) -> Change:
        def change(document: dict[str, Any]) -> None:
            document |= {"same": "x", "own": number}
            for case in document["cases"]:
                case["log"] = [number, {"a": None}]

        return change

    found = merged(protocol, *(changed(part, more(n)) for n, part in enumerate(data)))

    assert found["same"] == "x"
    assert found["own"] is None
    assert [row["own"] for row in found["shards"]] == [0, 1]
    assert {case["log"][0] for case in found["cases"]} == {0, 1}
    assert all(case["log"][1] == {"a": None} for case in found["cases"])


def test_the_longest_of_what_was_measured_is_the_longest_of_all(protocol: Protocol) -> None:
    def slow(document: dict[str, Any]) -> None:
        document["profile"] |= {"latency_max_ms": 7.5, "latency_median_ms": 3.0}

    first, second = shards(protocol, count=2)
    found = merged(protocol, first, changed(second, slow))

    assert found["profile"]["latency_max_ms"] == 7.5
    assert found["profile"]["latency_median_ms"] is None
    assert found["profile"]["truncation_timeout_ms"] == 50.0
    assert [row["profile"]["latency_median_ms"] for row in found["shards"]] == [0.0, 3.0]


# -- what is missing ------------------------------------------------------------------------------


def test_a_missing_shard_is_said_and_its_cases_are_inconclusive(protocol: Protocol) -> None:
    first, _, third = shards(protocol)

    found = merged(protocol, first, third)

    assert (found["exit"], found["verdict"]) == (3, "inconclusive")
    assert found["ended"] == "shard 2/3 missing"
    left = [case for case in found["cases"] if case["verdict"] == "inconclusive"]
    assert found["counts"]["inconclusive"] == len(left) > 5
    assert all(case["axes"]["answer"]["reason"] == "shard 2/3 missing" for case in left)
    # Of the eight colours that a whole run sends, one or more are missing.
    assert 0 < found["coverage"]["valid frames"]["done"] < 8


def test_a_missing_shard_does_not_hide_a_failure(protocol: Protocol) -> None:
    assert merged(protocol, *shards(protocol, "led-order-reversed")[:2])["exit"] == 1


def test_a_case_that_is_in_none_of_the_shards_is_missed(protocol: Protocol) -> None:
    first, second = shards(protocol, count=2)

    found = merged(protocol, changed(first, lambda d: d["cases"].pop()), second)

    assert (found["exit"], found["ended"]) == (3, "1 cases are in none of the shards")


ENDINGS = [
    ({"ended": "interrupted", "ended_by": "user"}, 3),
    ({"ended": "the probe hung up", "ended_by": "error"}, 2),
    ({"unusable": "nobody answered", "cases": []}, 2),
    ({"ended": "what a later kit calls power", "ended_by": "power"}, 2),
]


@pytest.mark.parametrize(("more", "code"), ENDINGS)
def test_a_shard_that_ended_early_decides_the_exit(
    protocol: Protocol, more: dict[str, Any], code: int
) -> None:
    first, second = shards(protocol, count=2)
    broken = changed(second, lambda document: document.update(more))

    assert merged(protocol, first, broken)["exit"] == code
    assert merged(protocol, first, broken)["ended"].startswith("shard 2/2: ")
    bad, _ = shards(protocol, "led-order-reversed", count=2)
    same = changed(broken, lambda d: d["link"].update(fault="led-order-reversed"))
    assert merged(protocol, bad, same)["exit"] == 1


# -- what does not belong together ----------------------------------------------------------------

STRANGE: list[tuple[Change, str]] = [
    (lambda d: d.update(seed=2), "the seed is 2 in one and 1 in the other"),
    (lambda d: d["options"].update(strict=True), "option strict is True"),
    (lambda d: d["options"].update(level="deep"), "option level is deep"),
    (lambda d: d["options"].update(only=["x"]), "option only is"),
    (lambda d: d["grammar"].update(sha256="0" * 64), "the grammar is 000000000000"),
    (lambda d: d.update(kit="9.9"), "the kit is 9.9"),
    (lambda d: d["link"].update(kind="port"), "the link is port"),
    (lambda d: d["link"].update(fault="x"), "the fault is x"),
    (lambda d: d["link"].update(probe="exec:x"), "the probe is exec in"),
    (lambda d: d["options"].update(shard=[2, 3]), "the number of shards is 3"),
    (lambda d: d["options"].update(shard=[1, 2]), "are both shard 1/2"),
    (lambda d: d["options"].update(shard=None), "not the report of a shard"),
    (lambda d: d["options"].update(shard=[3, 2]), "is not a report"),
    (lambda d: d["options"].update(shard=[True, 2]), "is not a report"),
    (lambda d: d["cases"][0].update(verdict="great"), "is not a report"),
    (lambda d: d["cases"][0].pop("axes"), "is not a report"),
    (lambda d: d.update(cases=3), "is not a report"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("change", "words"), STRANGE, ids=[words for _, words in STRANGE])
def test_parts_that_do_not_belong_together_are_refused(
    protocol: Protocol, change: Change, words: str
) -> None:
    first, second = shards(protocol, count=2)

    with pytest.raises(MergeError) as raised:
        merged(protocol, first, changed(second, change))

    assert words in str(raised.value)
    assert "1.json" in str(raised.value)


def test_several_devices_of_one_kind_may_share_a_run(protocol: Protocol) -> None:
    def port(number: int) -> Change:
        def change(document: dict[str, Any]) -> None:
            document["device"] = f"/dev/ttyUSB{number}"
            document["link"] |= {"probe": f"tcp:robot{number}:9000"}

        return change

    data = [changed(part, port(n)) for n, part in enumerate(shards(protocol, count=2))]

    assert merged(protocol, *data)["device"] == "/dev/ttyUSB0, /dev/ttyUSB1"


def test_what_differs_between_shards_leaves_a_report_that_can_be_read(
    protocol: Protocol, tmp_path: Path
) -> None:
    def other(document: dict[str, Any]) -> None:
        document["link"]["probe"] = "sim:2"
        document["grammar"]["file"] = "copy.py"
        document["timing"] = {"cases_s": 7.5}
        document["dropped"] = {"tours": 3}
        document["profile"]["readings"] |= {"R-drain-known": "another", "R-new": "chosen"}
        document["profile"]["facets"] = ["motion", "led"]

    first, second = shards(protocol, count=2)
    whole = merged(protocol, first, changed(second, other))
    file = tmp_path / "all.json"
    file.write_bytes(msgspec.json.encode(whole))

    report = read_report(str(file))

    assert report.link["probe"] == msgspec.json.decode(first)["link"]["probe"]
    assert report.grammar["file"] == protocol.origin
    assert (report.timing, report.dropped) == ({}, {})
    assert report.profile["readings"] is report.profile["facets"] is None
    show(report, Console(file=StringIO()))
    as_html([report], protocol)
    assert [shard["grammar"]["file"] for shard in whole["shards"]] == [protocol.origin, "copy.py"]


@pytest.mark.parametrize(
    "data", [b"", b"\xff\xfe", b"[]", b"{}", b"[" * 100_000, b'{"kit": 1}', b"null", b"1e999"]
)
def test_what_is_no_report_is_one_sentence(data: bytes) -> None:
    with pytest.raises(MergeError, match=r"x\.json is not a report of bilprov") as raised:
        shard_from("x.json", data)

    assert str(raised.value).isprintable()


# -- the command ----------------------------------------------------------------------------------


@pytest.fixture
def files(protocol: Protocol, tmp_path: Path) -> list[str]:
    """Two shards of a run whose LED is reversed."""
    names = []
    for number, data in enumerate(shards(protocol, "led-order-reversed", 2), 1):
        file = tmp_path / f"{number}.json"
        file.write_bytes(data)
        names.append(str(file))
    return names


@pytest.mark.slow
def test_expected_failures_hold_for_the_whole(files: list[str], tmp_path: Path) -> None:
    expected = tmp_path / "expected.txt"
    expected.write_text("* : state: led is\n")

    fits = command("merge", *files, "--expect-failures", str(expected), "--json", "-")
    expected.write_text("* : state: led is\nvalid/LED/0 : answer\n")
    stale = command("merge", *files, "--expect-failures", str(expected), "--json", "-")

    assert (fits.returncode, stale.returncode) == (0, 1)
    report = msgspec.json.decode(fits.stdout)
    assert report["expected_failures"]["expected"] == report["counts"]["fail"] > 8
    failing = [case for case in report["cases"] if case["verdict"] == "fail"]
    assert all(case["expected_failure"] for case in failing)
    (sentence_of_it,) = msgspec.json.decode(stale.stdout)["expected_failures"]["stale"]
    assert f"{expected}, line 2" in sentence_of_it


@pytest.mark.slow
def test_what_each_shard_expected_is_still_expected(tmp_path: Path) -> None:
    expected = tmp_path / "expected.txt"
    expected.write_text("valid/LED/* : state: led is\n")
    run = ("conform", "sim", "--only", "valid/LED/*", "--fault", "led-order-reversed")
    names = [str(tmp_path / f"{n}.json") for n in (1, 2)]
    for number, name in enumerate(names, 1):
        one = command(
            *(*run, "--shard", f"{number}/2", "--json", name),
            *("--expect-failures", str(expected)),
        )
        assert one.returncode == 0, one.stderr

    result = command("merge", *names, "--json", "-")

    report = msgspec.json.decode(result.stdout)
    assert (result.returncode, report["verdict"]) == (0, "fail")
    assert report["expected_failures"]["expected"] == report["counts"]["fail"] == 4


def test_shards_of_a_real_port_merge(protocol: Protocol, tmp_path: Path) -> None:
    names = [str(tmp_path / f"{n}.json") for n in (1, 2)]
    for number, name in enumerate(names, 1):
        with simulate() as robot:
            process(
                *("conform", robot.port, "--probe", robot.probe, "--yes"),
                *("--only", "valid/LED/*", "--only", "unused-id/9/?"),
                *("--shard", f"{number}/2", "--json", name),
            )

    result = command("merge", *names, "--json", "-")

    report = msgspec.json.decode(result.stdout)
    assert unwell(result) == {"power-on/Forward": "skipped"}, result.stderr.decode()
    chosen = [c for c in report["cases"] if c["id"].startswith(("valid/LED/", "unused-id/9/"))]
    assert [case["verdict"] for case in chosen] == ["pass"] * (8 + 10)
    assert report["counts"]["pass"] > len(chosen)  # the cases that every shard begins with
    assert report["device"].count("socket://") == 2


def test_a_part_keeps_its_results(protocol: Protocol) -> None:
    part: ShardReport = shard_from("a", report_of(protocol, "", (1, 1)))

    assert (part.index, part.of, len(part.report.results)) == (1, 1, len(part.raw["cases"]))


def test_times_that_differ_are_the_strictest_of_all_shards(protocol: Protocol) -> None:
    def timed(usual: float, timeout: float) -> Change:
        def change(document: dict[str, Any]) -> None:
            document["profile"]["all_but_two_answers_ms"] = usual
            document["profile"]["truncation_timeout_ms"] = timeout

        return change

    first, second = shards(protocol, count=2)

    found = merged(protocol, changed(first, timed(3, 51)), changed(second, timed(40, 50)))

    assert found["profile"]["all_but_two_answers_ms"] == 40
    assert found["profile"]["truncation_timeout_ms"] == 50
