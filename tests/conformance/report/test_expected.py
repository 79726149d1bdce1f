"""Expected failures do not count; new failures, and entries that no longer fail, do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict
from bilprov.conformance.report.expected import Entry, ExpectedFile, Matches, match, parse_expected
from bilprov.conformance.report.run_report import Comparison
from bilprov.spec.protocol import Protocol
from tests.support.reports import every_verdict, with_axes

FAIL = Verdict.FAIL


def result(ident: str, **axes: tuple[Verdict, str]) -> CaseResult:
    return with_axes(ident, {n: Axis(verdict, "e", "a", why) for n, (verdict, why) in axes.items()})


def passed(ident: str) -> CaseResult:
    return result(ident, answer=(Verdict.PASS, ""))


def failed(ident: str, reason: str = "no answer came") -> CaseResult:
    return result(ident, answer=(FAIL, reason))


# -- the text -------------------------------------------------------------------------------------


def test_an_entry_is_a_glob_an_axis_and_a_message_that_may_be_left_out() -> None:
    text = "# why\n\n  a/* : answer: no\n\tb : stop: x : y\r\n# not : this\nc : state\n"

    assert parse_expected(text, "F") == (
        Entry("a/*", "answer", "no", 3),
        Entry("b", "stop", "x : y", 4),
        Entry("c", "state", "", 6),
    )


# -- what counts ----------------------------------------------------------------------------------

SUITE = ("a/1", "a/2", "b/1")


def matched(text: str, *results: CaseResult, **more: Any) -> Matches:
    return match(parse_expected(text, "F"), results, more.pop("suite", SUITE), **more)


def test_a_failure_as_an_entry_says_is_expected() -> None:
    found = matched("a/* : answer: no\n", failed("a/1"), passed("a/2"), failed("b/1"))

    assert found == Matches(frozenset({"a/1"}), ("b/1 : answer: no answer came",), ())


@pytest.mark.parametrize("message", ["", ": no answer came", ": as an older kit worded it"])
def test_a_failure_is_known_by_its_axis_however_it_is_worded(message: str) -> None:
    found = matched(f"a/1 : answer{message}", failed("a/1"))

    assert found == Matches(frozenset({"a/1"}), (), ())


@pytest.mark.parametrize("line", ["a/1 : stop: no", "a/2 : answer: no"])
def test_a_failure_of_another_axis_or_case_is_not_expected(line: str) -> None:
    found = matched(line, failed("a/1"))

    assert (found.expected, len(found.unexpected)) == (frozenset(), 1)


def test_a_second_axis_that_fails_is_not_hidden_by_the_first() -> None:
    both = result("a/1", answer=(FAIL, "no answer came"), stop=(FAIL, ""))

    none, one = matched("", both), matched("a/1 : answer: no\n", both)
    two = matched("a/1 : answer: no\na/* : stop\n", both)

    assert none.unexpected == ("a/1 : answer: no answer came", "a/1 : stop: a instead of e")
    assert (one.expected, one.unexpected) == (frozenset(), none.unexpected[1:])
    assert (two.expected, two.unexpected) == ({"a/1"}, ())


@pytest.mark.parametrize("verdict", [Verdict.ERROR, Verdict.INCONCLUSIVE, Verdict.NON_STRICT])
def test_only_a_failure_is_ever_expected(verdict: Verdict) -> None:
    case = result("a/1", answer=(FAIL, "no"), stop=(verdict, "no"))
    worse = result("a/2", answer=(verdict, "no"))

    found = matched("a/* : answer: no\n", case, worse)

    assert found.expected == ({"a/1"} if verdict < FAIL else frozenset())


STALE = [
    ([passed("a/1"), passed("a/2")], 1),
    ([result("a/1", answer=(Verdict.NON_STRICT, "")), passed("a/2")], 1),
    ([passed("a/1")], 0),  # the other was left out (--only)
    ([], 0),
    ([passed("a/1"), result("a/2", answer=(Verdict.INCONCLUSIVE, "not run"))], 0),
    ([passed("a/1"), result("a/2", answer=(Verdict.SKIPPED, "not run"))], 0),
    ([passed("a/1"), failed("a/2")], 0),  # one of the two is enough
    ([passed("a/1"), result("a/2", stop=(FAIL, ""))], 0),  # that one counts itself
]


@pytest.mark.parametrize(("results", "count"), STALE)
def test_an_entry_is_stale_when_all_of_its_cases_were_judged_and_none_fails(
    results: list[CaseResult], count: int
) -> None:
    found = matched("\na/* : answer: no\n", *results)

    assert found.stale == (Entry("a/*", "answer", "no", 2),) * count


def test_an_answer_that_nobody_asked_for_is_stale_only_after_a_whole_run() -> None:
    line, suite = "line/unsolicited : answer\n", (*SUITE, "line/unsolicited")

    whole = matched(line, passed("a/1"), suite=suite)
    broken_off = matched(line, passed("a/1"), suite=suite, whole=False)

    assert (len(whole.stale), len(broken_off.stale)) == (1, 0)


# -- the update -----------------------------------------------------------------------------------


def test_an_update_says_what_fails_now_and_keeps_comments_and_what_was_not_run(
    tmp_path: Path, protocol: Protocol
) -> None:
    path = tmp_path / "known"
    path.write_text("# one\na/1 : answer: no\n# two\na/2 : answer: no\nc/1 : stop\n# end")
    results = (passed("a/1"), failed("a/2"), failed("b/1", "answered after 103 ms"))
    report, suite = replace(every_verdict(protocol), results=results), (*SUITE, "c/1")

    file = ExpectedFile(str(path), suite, update=True)
    after, said = file.applied(report)

    assert path.read_text() == (
        "# one\n# two\na/2 : answer: no\nc/1 : stop\n# end\nb/1 : answer: answered after 103 ms\n"
    )
    assert said == f"{path}: 1 added, 1 removed"
    assert after.comparison == Comparison(str(path), 2, 0, ())
    assert [r.expected_failure for r in after.results] == [False, True, True]
    assert file.applied(report)[1] == f"{path} fits"


def test_an_entry_of_another_level_has_no_effect() -> None:
    assert matched("deep/1 : answer\n", passed("a/1")) == Matches(frozenset(), (), ())
