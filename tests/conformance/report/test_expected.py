"""Expected failures do not count; new failures, and entries that no longer fail, do."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.conformance import api
from bilprov.conformance.api import Options, suite_ids
from bilprov.conformance.cli.options import expected_file
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict
from bilprov.conformance.report.expected import (
    Entry,
    ExpectedError,
    ExpectedFile,
    Matches,
    match,
    parse_expected,
)
from bilprov.conformance.report.run_report import Comparison
from bilprov.spec.protocol import Protocol
from tests.support.commands import command
from tests.support.reports import every_verdict
from tests.support.robots import sentence

FAIL = Verdict.FAIL


def result(ident: str, **axes: tuple[Verdict, str]) -> CaseResult:
    judged = {name: Axis(verdict, "e", "a", reason) for name, (verdict, reason) in axes.items()}
    verdict = max(axis.verdict for axis in judged.values())
    return CaseResult(
        id=ident,
        clause="1",
        requirement="r",
        verdict=verdict,
        axes=judged,
        reading=None,
        sent=(),
        received=(),
    )


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


@pytest.mark.parametrize(
    "line", ["a/*", "a/* :", ": answer", "a/*: answer", "a/*:answer", "a : ans", "a : no", "x\x1b"]
)
def test_a_line_that_is_no_entry_is_named(line: str) -> None:
    with pytest.raises(ExpectedError, match="F, line 2 is") as raised:
        parse_expected(f"# first\n{line}\n", "F")

    assert "GLOB : AXIS: MESSAGE" in str(raised.value)
    assert str(raised.value).isprintable()


def test_an_entry_that_no_case_fits_is_wrong_use(tmp_path: Path) -> None:
    path = tmp_path / "known"
    path.write_text("a : answer\n\nb* : answer\n")

    with pytest.raises(ExpectedError, match="known, line 3: no case matches 'b"):
        ExpectedFile(str(path), lambda: ["a", "c"], ["a"])
    ExpectedFile(str(path), lambda: ["a", "bc"], ["a"])


def test_so_many_entries_that_each_run_would_crawl_are_refused() -> None:
    with pytest.raises(ExpectedError, match="more than 10000"):
        parse_expected("a : stop\n" * 10_001, "F")


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

    file = ExpectedFile(str(path), lambda: suite, suite, update=True)
    after, said = file.applied(report)

    assert path.read_text() == (
        "# one\n# two\na/2 : answer: no\nc/1 : stop\n# end\nb/1 : answer: answered after 103 ms\n"
    )
    assert said == f"{path}: 1 added, 1 removed"
    assert after.comparison == Comparison(str(path), 2, 0, ())
    assert [r.expected_failure for r in after.results] == [False, True, True]
    assert file.applied(report)[1] == f"{path} fits"


def test_a_stale_entry_is_a_failure_and_is_said_with_its_line(
    tmp_path: Path, protocol: Protocol
) -> None:
    path = tmp_path / "known"
    path.write_text("\na/* : answer: no\n")
    report = replace(every_verdict(protocol), results=(passed("a/1"), passed("a/2")), exit=0)

    after, said = ExpectedFile(str(path), lambda: SUITE, SUITE).applied(report)

    assert after.comparison is not None
    (sentence,) = after.comparison.stale
    assert sentence.startswith(f"{path}, line 2: a/* : answer: no: its 2 cases do not fail")
    assert (after.exit, said) == (1, "")


# -- the command ----------------------------------------------------------------------------------

LED = ("conform", "sim", "--fault", "led-order-reversed", "--only", "valid/LED/*")


def run(*arguments: str, file: Path) -> tuple[int, dict[str, Any], str]:
    done = command(*arguments, "--expect-failures", str(file), "--json", "-")
    report = msgspec.json.decode(done.stdout)
    assert report["exit"] == done.returncode
    return done.returncode, report, done.stderr.decode()


@pytest.fixture
def entries(tmp_path: Path) -> Path:
    """What the reversed LED does to valid/LED/*, as the kit wrote it down."""
    file = tmp_path / "expected.txt"
    code, _, told = run(*LED, "--update-expected", file=file)
    assert code == 0
    assert f"{file}: 4 added, 0 removed" in told
    return file


def test_an_update_replaces_what_a_link_leads_to_and_keeps_its_mode(entries: Path) -> None:
    entries.chmod(0o640)
    link = entries.with_name("link")
    link.symlink_to(entries)

    code, _, told = run("conform", "sim", "--only", "valid/LED/*", "--update-expected", file=link)

    assert code == 0
    assert "0 added, 4 removed" in told
    assert link.is_symlink()
    assert entries.stat().st_mode & 0o777 == 0o640
    assert entries.read_text().startswith("# ")
    assert not [p for p in entries.parent.iterdir() if p.name.startswith(".")]


@pytest.mark.slow
def test_what_could_not_be_judged_is_never_hidden(tmp_path: Path) -> None:
    file = tmp_path / "f"
    file.write_text("unused-id/9/* : answer\nunused-id/9/* : stop\nunused-id/9/* : state\n")
    only = ("--only", "unused-id/9/[0-3]")

    assert run("conform", "sim", "--fault", "never-moves", *only, file=file)[0] == 3


def test_one_file_serves_every_level(
    tmp_path: Path, protocol: Protocol, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(api, "suite_ids", lambda _, options: (f"{options.level}/1",))
    file = tmp_path / "f"
    file.write_text("deep/1 : answer\ncomplete/1 : answer\n")

    assert expected_file(protocol, Options(level="smoke"), str(file)) is not None
    file.write_text("valid/1 : answer\n")
    with pytest.raises(ExpectedError, match="no case matches 'valid/1'"):
        expected_file(protocol, Options(level="smoke"), str(file))


@pytest.mark.sample(0)
@pytest.mark.slow
def test_another_grammar_has_entries_of_its_own(tmp_path: Path, horn_text: str) -> None:
    grammar, file = tmp_path / "horn.py", tmp_path / "f"
    grammar.write_text(horn_text)
    file.write_text("valid/Horn/* : answer\n")
    only = ("conform", "sim", "--level", "smoke", "--only", "valid/Stop")

    assert run("--grammar", str(grammar), *only, file=file)[0] == 0
    wrong = command(*only, "--expect-failures", str(file))
    assert wrong.returncode == 2
    assert f"{file}, line 1: no case matches 'valid/Horn/*'" in sentence(wrong)


def _hostile(tmp_path: Path, kind: str) -> Path:
    file = tmp_path / "f"
    if kind == "folder":
        file.mkdir()
    elif kind == "fifo":
        os.mkfifo(file)
    elif kind == "binary":
        file.write_bytes(b"\xff\xfe\x00")
    elif kind == "zeros":
        file.write_bytes(b"a : b\n\0")
    elif kind == "huge":
        file.write_bytes(b"#" * ((1 << 20) + 1))
    elif kind == "words":
        file.write_bytes("valid/\x1b[31m‮\n".encode())
    elif kind == "nul":
        return tmp_path / "a\0b"
    return file


@pytest.mark.parametrize(
    "kind", ["missing", "folder", "fifo", "binary", "zeros", "huge", "words", "nul"]
)
def test_a_file_that_cannot_be_used_is_one_sentence(tmp_path: Path, kind: str) -> None:
    known = suite_ids_here()

    with pytest.raises(ExpectedError) as raised:
        ExpectedFile(str(_hostile(tmp_path, kind)), lambda: known, known)

    assert str(raised.value).isprintable()
    if kind != "nul":
        result = command(
            "conform", "sim", "--level", "smoke", "--expect-failures", str(tmp_path / "f")
        )
        assert (result.returncode, result.stdout) == (2, b"")
        assert len(result.stderr.decode().splitlines()) == 1
        assert sentence(result).startswith("bilprov: ")


def suite_ids_here() -> tuple[str, ...]:
    from bilprov.conformance.api import Options

    return suite_ids(load_protocol(), Options(level="smoke"))
