"""Expected failures do not count; new failures, and entries that no longer fail, do."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec
import pytest

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.conformance import api
from bilprov.conformance.api import Options, suite_ids
from bilprov.conformance.cli.options import expected_file
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict
from bilprov.conformance.report.expected import (
    Entry,
    ExpectedError,
    compare,
    failures,
    parse_expected,
    require_known,
    updated,
)
from bilprov.conformance.report.expected_file import ExpectedFile
from bilprov.spec.protocol import Protocol
from tests.support.commands import command
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


def test_an_entry_that_no_case_fits_is_wrong_use() -> None:
    entries = parse_expected("a : answer\n\nb* : answer\n", "F")

    with pytest.raises(ExpectedError, match="F, line 3: no case matches 'b"):
        require_known(entries, "F", ["a", "c"])
    require_known(entries, "F", ["a", "bc"])


def test_so_many_entries_that_each_run_would_crawl_are_refused() -> None:
    with pytest.raises(ExpectedError, match="more than 10000"):
        parse_expected("a : stop\n" * 10_001, "F")


# -- what counts ----------------------------------------------------------------------------------

SUITE = ("a/1", "a/2", "b/1")


def test_a_failure_as_an_entry_says_is_expected() -> None:
    results = [failed("a/1"), passed("a/2"), failed("b/1")]

    found, ids = compare(parse_expected("a/* : answer: no\n", "F"), "F", results, SUITE)

    assert (ids, found.unexpected, found.stale) == ({"a/1"}, 1, ())


@pytest.mark.parametrize("message", ["", ": no answer came", ": as an older kit worded it"])
def test_a_failure_is_known_by_its_axis_however_it_is_worded(message: str) -> None:
    found, ids = compare(parse_expected(f"a/1 : answer{message}", "F"), "F", [failed("a/1")], SUITE)

    assert (ids, found.unexpected, found.stale) == ({"a/1"}, 0, ())


@pytest.mark.parametrize("line", ["a/1 : stop: no", "a/2 : answer: no"])
def test_a_failure_of_another_axis_or_case_is_not_expected(line: str) -> None:
    found, ids = compare(parse_expected(line, "F"), "F", [failed("a/1")], SUITE)

    assert (ids, found.unexpected) == (set(), 1)


def test_a_second_axis_that_fails_is_not_hidden_by_the_first() -> None:
    both = result("a/1", answer=(FAIL, "no answer came"), stop=(FAIL, "still moves"))

    one, one_ids = compare(parse_expected("a/1 : answer: no\n", "F"), "F", [both], SUITE)
    two, two_ids = compare(
        parse_expected("a/1 : answer: no\na/* : stop\n", "F"), "F", [both], SUITE
    )

    assert (one_ids, one.unexpected, one.stale) == (set(), 1, ())
    assert (two_ids, two.unexpected) == ({"a/1"}, 0)


@pytest.mark.parametrize("verdict", [Verdict.ERROR, Verdict.INCONCLUSIVE, Verdict.NON_STRICT])
def test_only_a_failure_is_ever_expected(verdict: Verdict) -> None:
    case = result("a/1", answer=(FAIL, "no"), stop=(verdict, "no"))
    worse = result("a/2", answer=(verdict, "no"))
    entries = parse_expected("a/* : answer: no\n", "F")

    _, ids = compare(entries, "F", [case, worse], SUITE)

    assert ids == ({"a/1"} if verdict < FAIL else set())


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
    found, _ = compare(parse_expected("\na/* : answer: no\n", "F"), "F", results, SUITE)

    assert len(found.stale) == count
    assert all(s.startswith("F, line 2: a/* : answer: no: its 2 cases") for s in found.stale)


def test_an_answer_that_nobody_asked_for_is_stale_only_after_a_whole_run() -> None:
    entries = parse_expected("line/unsolicited : answer\n", "F")
    suite = (*SUITE, "line/unsolicited")

    whole, _ = compare(entries, "F", [passed("a/1")], suite)
    broken_off, _ = compare(entries, "F", [passed("a/1")], suite, whole=False)

    assert (len(whole.stale), len(broken_off.stale)) == (1, 0)


# -- the update -----------------------------------------------------------------------------------


def test_an_update_says_what_fails_now_and_keeps_comments_and_what_was_not_run() -> None:
    text = "# one\na/1 : answer: no\n# two\na/2 : answer: no\nc/1 : stop\ngone/1 : stop\n# end"
    results = [passed("a/1"), failed("a/2"), failed("b/1", "answered after 103 ms")]
    suite = (*SUITE, "c/1")

    change = updated(text, "F", results, suite, suite)

    assert change.text == (
        "# one\n# two\na/2 : answer: no\nc/1 : stop\n# end\nb/1 : answer: answered after 103 ms\n"
    )
    assert change.removed == ("a/1 : answer: no", "gone/1 : stop")
    assert change.added == ("b/1 : answer: answered after 103 ms",)
    again = updated(change.text, "F", results, suite, suite)
    assert (again.text, again.added, again.removed) == (change.text, (), ())
    after, after_ids = compare(parse_expected(change.text, "F"), "F", results, suite)
    assert (after_ids, after.unexpected, after.stale) == ({"a/2", "b/1"}, 0, ())


def test_an_update_gives_each_axis_that_fails_an_entry() -> None:
    both = result("a/1", answer=(FAIL, "no answer came"), stop=(FAIL, "still moves 3 ms after"))

    change = updated("", "F", [both], SUITE, SUITE)

    assert change.added == ("a/1 : answer: no answer came", "a/1 : stop: still moves 3 ms after")
    assert change.text.startswith("# ")
    assert compare(parse_expected(change.text, "F"), "F", [both], SUITE)[0].unexpected == 0


def test_line_ends_stay_what_they_were() -> None:
    change = updated("# x\r\na/1 : stop: no\r\n", "F", [passed("a/1"), failed("b/1")], SUITE, SUITE)

    assert change.text == "# x\r\nb/1 : answer: no answer came\r\n"


def test_a_reason_that_is_missing_is_made_of_what_came() -> None:
    assert failures(result("a", answer=(FAIL, ""))) == {"answer": "a instead of e"}


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


def test_a_line_that_cannot_be_judged_leaves_the_file_alone(entries: Path) -> None:
    before = entries.read_bytes()

    code, report, _ = run("conform", "sim", "--fault", "echo", "--update-expected", file=entries)

    assert (code, entries.read_bytes()) == (2, before)
    assert report["unusable"]
    none = entries.with_name("none")
    assert run("conform", "sim", "--fault", "echo", "--update-expected", file=none)[0] == 2
    assert not none.exists()


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
        result = command("conform", "sim", "--expect-failures", str(tmp_path / "f"))
        assert (result.returncode, result.stdout) == (2, b"")
        assert len(result.stderr.decode().splitlines()) == 1
        assert sentence(result).startswith("bilprov: ")


def suite_ids_here() -> tuple[str, ...]:
    from bilprov.conformance.api import Options

    return suite_ids(load_protocol(), Options())
