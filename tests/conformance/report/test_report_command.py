"""`bilprov report`, and the reports of `conform`: complete, checked before the run, lossless."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import click
import pytest
from msgspec.structs import replace

from bilprov.conformance.cases.levels import Options
from bilprov.conformance.cli.outputs import Outputs
from bilprov.conformance.oracle.verdicts import CaseResult, Cause, Verdict
from bilprov.conformance.report.grouping import changed_cases, changed_causes, names, rows
from bilprov.conformance.report.html.page import as_html
from bilprov.conformance.report.json_report import ReportError, as_json, parse_report, read_report
from bilprov.conformance.report.junit import as_junit
from bilprov.conformance.report.run_report import Comparison, Report, reproducer
from bilprov.spec.protocol import Protocol
from tests.support.commands import command
from tests.support.reports import a_case, a_run, every_verdict, hostile

pytestmark = pytest.mark.waits


def saved(report: Report, folder: Path, name: str = "run.json") -> Path:
    file = folder / name
    file.write_bytes(as_json(report))
    return file


# -- a report is read back as the value that it was -----------------------------------------------


@pytest.mark.parametrize("fault", ["", "restarts-by-itself", "silent-on-faults"])
def test_a_report_read_back_is_the_same_value(
    protocol: Protocol, tmp_path: Path, fault: str
) -> None:
    report = a_run(protocol, "bad-data/LED/1?", "unused-id/9/*", "truncated/LED/*", fault=fault)

    file = saved(report, tmp_path)

    assert read_report(str(file)) == replace(report, file=str(file))
    assert as_json(read_report(str(file))) == file.read_bytes()


def test_nothing_that_a_run_says_is_lost(protocol: Protocol, tmp_path: Path) -> None:
    """What Ctrl-C and a file of expected failures leave in a report, too."""
    base = every_verdict(protocol)
    report = replace(
        base,
        ended="stopped by the user",
        ended_by="user",
        timing={"bytes_sent": 12, "wire_s": 0.25},
        comparison=Comparison("known.toml", 1, 2, ("more/9 passes now",)),
        results=tuple(replace(r, expected_failure=r.id == "more/1") for r in base.results),
    )
    again = read_report(str(saved(report, tmp_path)))

    assert as_json(again) == as_json(report)
    assert again == replace(report, file=again.file)


def test_what_this_version_does_not_know_is_passed_over(protocol: Protocol, tmp_path: Path) -> None:
    report = a_run(protocol, "valid/LED/1")
    document = json.loads(as_json(report))
    document["later"] = {"x": 1}
    document["cases"][0]["later"] = [1]
    document["cases"][0]["axes"]["answer"]["later"] = None
    file = tmp_path / "later.json"
    file.write_text(json.dumps(document))

    assert as_json(read_report(str(file))) == as_json(report)


CASE = "conform x --seed 1 --only tour/1"


@pytest.mark.parametrize(
    ("link", "args", "command"),
    [
        ({"kind": "virtual", "probe": "sim", "fault": None}, "", CASE),
        ({"kind": "virtual", "probe": "sim", "fault": "int8"}, "", f"{CASE} --fault int8"),
        ({"kind": "virtual"}, "11 7f 20", "send PORT 11 7f 20"),
        ({"kind": "port", "probe": "exec:a b"}, "11 7f", "send x 11 7f"),
        ({"kind": "port", "options": "--echo"}, "11 7f", "send x --echo 11 7f"),
        ({"kind": "port", "options": "--baud 9600 --echo"}, "", f"{CASE} --baud 9600 --echo"),
        ({"kind": "port", "probe": "exec:a b"}, "", f"{CASE} --probe 'exec:a b'"),
    ],
)
def test_the_command_that_shows_a_case_again(
    link: dict[str, object], args: str, command: str
) -> None:
    case = replace(a_case("tour/1", Verdict.FAIL), reproduce=args)

    assert reproducer("grammar.py", "x", link, Options())(case) == f"bilprov {command}"
    if not args:
        soaked = reproducer("grammar.py", "x", link, Options(soak=70))(case)
        assert soaked.startswith(f"bilprov {CASE} --soak 70")
    own = reproducer("my.py", "x", link, Options())(case)
    assert own == f"bilprov --grammar my.py {command}"


def changed(document: dict[str, Any], path: str, value: object) -> str:
    *way, last = path.split(".")
    place: Any = document
    for step in way:
        place = place[int(step)] if step.isdigit() else place[step]
    place[last] = value
    return json.dumps(document)


def a_sent(t: float, kind: str = "sent") -> list[dict[str, object]]:
    """A log of one entry, at this time (s)."""
    return [{"t": t, "kind": kind, "hex": "", "look": ""}]


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("verdict", "fine"),
        ("exit", "7"),
        ("cases.0.log", a_sent(0, "eaten")),
        ("cases.0.log", a_sent(1e300)),
        ("cases.0.sent", ["<b>"]),
        ("coverage", {"headers": {"done": -1, "of": 1}}),
    ],
)
def test_a_wrong_file_is_one_sentence(
    protocol: Protocol, tmp_path: Path, path: str, value: object
) -> None:
    file = tmp_path / "wrong.json"
    file.write_text(changed(json.loads(as_json(a_run(protocol, "valid/LED/1"))), path, value))

    with pytest.raises(ReportError, match=r"wrong\.json is not a report of bilprov") as raised:
        read_report(str(file))

    assert "\n" not in str(raised.value)


def test_the_sums_of_a_file_are_those_of_its_cases(protocol: Protocol, tmp_path: Path) -> None:
    file = tmp_path / "mended.json"
    document = json.loads(as_json(a_run(protocol, "valid/LED/1")))
    file.write_text(changed(document, "cases.0.verdict", "fail"))

    report = read_report(str(file))

    assert document["exit"] == 0
    assert (report.verdict, report.exit, report.counts["fail"]) == (Verdict.FAIL, 1, 1)
    assert json.loads(as_json(report))["exit"] == 1


# -- side by side ---------------------------------------------------------------------------------


def with_cases(report: Report, *idents: str) -> Report:
    results: tuple[CaseResult, ...] = tuple(a_case(ident, Verdict.PASS) for ident in idents)
    return replace(report, results=results)


def test_cases_stand_beside_one_another_in_the_order_of_the_runs(protocol: Protocol) -> None:
    base = every_verdict(protocol)
    one, two = with_cases(base, "a", "b", "d"), with_cases(base, "z", "a", "c", "d", "e")
    found = rows([one, two])

    assert [row.id for row in found] == ["a", "b", "d", "z", "c", "e"]
    assert [row.id for row in found if None in row.results] == ["b", "z", "c", "e"]
    assert not any(row.differs for row in found)


def test_a_report_in_which_an_id_stands_twice_is_refused(protocol: Protocol) -> None:
    report = with_cases(every_verdict(protocol), "a", "a", "b")

    with pytest.raises(ReportError, match=r"x\.json holds the case a twice"):
        parse_report(as_json(report), "x.json")


def test_several_runs_are_told_apart_by_device_or_file_and_when_they_began(
    protocol: Protocol,
) -> None:
    base = every_verdict(protocol)
    faulty = replace(base, link=base.link | {"fault": "x"})
    monday = replace(base, file="monday.json")
    tuesday = replace(base, file="b.json", begun="2026-11-24T09:05:07+00:00")

    assert names([base, faulty]) == ["sim", "sim --fault x"]
    assert names([monday, tuesday]) == ["monday.json", "b.json (2026-11-24 09:05 UTC)"]
    assert names([monday]) == ["sim"]


# -- what changed ---------------------------------------------------------------------------------


def test_each_case_that_failed_once_is_fixed_new_still_failing_or_not_judged(
    protocol: Protocol,
) -> None:
    found = {
        "fixed": (Verdict.FAIL, Verdict.NON_STRICT),
        "still failing": (Verdict.FAIL, Verdict.FAIL),
        "failed before, not judged now": (Verdict.FAIL, Verdict.INCONCLUSIVE),
        "failing, not judged before": (Verdict.SKIPPED, Verdict.FAIL),
        "newly failing": (Verdict.PASS, Verdict.FAIL),
    }
    others = {"fine": (Verdict.PASS, Verdict.PASS), "dark": (Verdict.PASS, Verdict.ERROR)}
    base = every_verdict(protocol)
    first, last = (
        replace(base, results=tuple(a_case(ident, v[at]) for ident, v in (found | others).items()))
        for at in (0, 1)
    )
    absent = replace(first, results=())

    assert changed_cases(rows([first, last])) == {change: [change] for change in found}
    # A run between them does not count, and what was not run was not judged.
    assert changed_cases(rows([first, absent, last])) == {change: [change] for change in found}
    assert set(changed_cases(rows([first, absent]))) == {"failed before, not judged now"}
    assert set(changed_cases(rows([absent, last]))) == {"failing, not judged before"}


def a_cause(sentence: str, *cases: str) -> Cause:
    return Cause(sentence, "always", "stop", "section 2", cases, 0, ("81", "09"))


def test_causes_are_compared_by_their_sentences_then_by_most_cases_alike() -> None:
    first = [a_cause("same", "a/1"), a_cause("all of 9", "a/2", "a/3"), a_cause("old", "a/4")]
    last = [a_cause("new", "a/5"), a_cause("same", "a/9")]
    last += [a_cause("all of 7", "a/3"), a_cause("all of 8", "a/2", "a/3")]

    changes = changed_causes(first, last)

    assert [(c.change, c.cause.sentence, c.before) for c in changes] == [
        ("still there", "same", ""),
        ("changed", "all of 8", "all of 9"),
        ("gone", "old", ""),
        ("new", "new", ""),
        ("new", "all of 7", ""),
    ]


@pytest.mark.parametrize("count", [1, 2])
def test_a_hostile_result_does_not_control_the_terminal(
    protocol: Protocol, tmp_path: Path, count: int
) -> None:
    evil = "[bold] \x1b]0;owned\x07\x9b31m\u202e\r\x08[/red][link=x]"
    file = saved(hostile(protocol, evil), tmp_path)

    result = command("report", *[str(file)] * count)
    said = result.stdout.decode()

    assert result.returncode == 0
    assert "[/red][link=x]" in said
    assert [line for line in said.splitlines() if line.startswith("│") and "[bold]" in line]
    assert not [c for c in said if not c.isprintable() and c != "\n"]


def test_the_bytes_of_another_grammar_have_words_where_it_is_named(
    horn: Protocol, horn_text: str, tmp_path: Path
) -> None:
    grammar = tmp_path / "horn.py"
    grammar.write_text(horn_text, encoding="utf-8")
    file = saved(a_run(horn, "valid/Horn/3"), tmp_path)

    told = command("--grammar", str(grammar), "report", str(file), "--html", "-").stdout.decode()

    assert "Horn sound=3" in told


# -- where reports are written --------------------------------------------------------------------


def test_a_file_that_this_user_may_not_write_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The tests may run as root, whom no mode keeps from anything.
    monkeypatch.setattr(os, "access", lambda path, mode: False)

    with pytest.raises(click.UsageError, match="this user may not"):
        Outputs({"html": str(tmp_path / "out")}).require_writable()


# -- a case stands under one clause, whatever became of it ----------------------------------------


def failing_walk() -> tuple[CaseResult, CaseResult]:
    """A walk that passes, and one that fails and says which clause that breaks."""
    passed = a_case("tour/1", Verdict.PASS)
    failed = replace(
        a_case("tour/1", Verdict.FAIL), clause="section 5", planned_clause="section 4, table 2"
    )
    return passed, failed


def rows_of_the_matrix(page: str) -> list[str]:
    matrix = page.partition('<table class="matrix">')[2].partition("</table>")[0]
    return re.findall(r'class="clause"><a [^>]*>([^<]*)<', matrix)


@pytest.mark.parametrize("first", [0, 1])
def test_a_case_stands_under_the_same_clause_on_every_page(protocol: Protocol, first: int) -> None:
    base = every_verdict(protocol)
    runs = [replace(base, results=(case,)) for case in failing_walk()]
    runs = runs[first:] + runs[:first]

    pages = [as_html(some, protocol) for some in (runs, runs[:1], runs[1:])]

    assert [rows_of_the_matrix(page) for page in pages] == [["section 4, table 2"]] * 3
    assert all('data-c="section 4, table 2"' in page for page in pages)
    assert "what fails: section 5" in pages[0]
    tests = as_junit(runs, protocol)
    assert set(re.findall(r'classname="sim: ([^"]*)"', tests)) == {"section 4, table 2"}
    assert "fail (section 5)" in tests


def test_a_walk_of_a_real_run_keeps_its_row(protocol: Protocol) -> None:
    only = "sequence/tour/01?"
    good = a_run(protocol, only)
    bad = a_run(protocol, only, fault="led-order-reversed")
    failed = [result for result in bad.results if result.verdict is Verdict.FAIL]
    own = {result.id: result.clause for result in good.results}

    assert any(result.clause != own[result.id] for result in failed)
    assert {result.id: result.planned_clause for result in bad.results} == own


def test_both_clauses_are_read_back_and_an_old_report_has_but_one(
    protocol: Protocol, tmp_path: Path
) -> None:
    _, failed = failing_walk()
    file = saved(replace(every_verdict(protocol), results=(failed,)), tmp_path)
    document = json.loads(file.read_bytes())
    (case,) = document["cases"]

    (again,) = read_report(str(file)).results
    assert again == failed
    assert (case["clause"], case["planned_clause"]) == ("section 5", "section 4, table 2")
    del case["planned_clause"]
    file.write_text(json.dumps(document))
    (old,) = read_report(str(file)).results
    assert (old.clause, old.planned_clause) == ("section 5", "section 5")


# -- when, where and with what a run was made -----------------------------------------------------


def test_every_form_says_when_where_and_with_what_a_run_was_made(tmp_path: Path) -> None:
    files = {kind: tmp_path / kind for kind in ("json", "junit", "markdown", "html")}
    asked = [word for kind, file in files.items() for word in (f"--{kind}", str(file))]

    result = command("conform", "sim", "--only", "valid/LED/1", *asked)

    document = json.loads(files["json"].read_text())
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", document["begun"])
    assert document["took_s"] >= 0
    assert set(document["versions"]) == {"Python", "platform", "pyserial", "construct"}
    for told in (result.stdout.decode(), *(file.read_text() for file in files.values())):
        for words in (document["begun"], document["host"], document["versions"]["pyserial"]):
            assert words in told
    suite = files["junit"].read_text()
    assert f'timestamp="{document["begun"]}" hostname="{document["host"]}"' in suite
