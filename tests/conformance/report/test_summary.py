"""Reports for people: the summary and Markdown."""

from __future__ import annotations

import re

import pytest
from markdown_it import MarkdownIt
from markdown_it.token import Token
from msgspec.structs import replace

from bilprov.captures.text import escape_controls
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.oracle.profile import Figures
from bilprov.conformance.oracle.verdicts import Axis, Verdict, WireEvent
from bilprov.conformance.report.html.page import WireWords, as_html
from bilprov.conformance.report.json_report import as_json
from bilprov.conformance.report.markdown import as_markdown, code, prose
from bilprov.conformance.report.run_report import Grammar, Report, conclusion
from bilprov.spec.protocol import Protocol
from tests.support.reports import a_case, a_run, every_form, every_verdict, hostile, shown
from tests.support.robots import Blind
from tests.support.surfaces import HOSTILE


@pytest.fixture
def unseen(protocol: Protocol) -> Report:
    options = Options(only=("bad-data/LED/9", "valid/LED/1", "truncated/Right/0"))
    report = conform(Blind(Simulator(protocol)), grammar=protocol, options=options)
    assert report.link["probe"] == "none"
    return report


def test_every_form_says_what_was_not_seen_and_what_to_know(protocol: Protocol) -> None:
    told = "From observation 600 on the probe saw less", "the device never gives up a frame"
    report = replace(every_verdict(protocol), unseen=told[:1], notices=told[1:])

    for text in (as_json(report).decode(), *every_form(report, protocol).values()):
        assert [words for words in told if words not in text] == []


def test_an_informational_case_is_listed_with_its_reason_if_all_are(protocol: Protocol) -> None:
    report = every_verdict(protocol)
    odd = a_case("made/odd", Verdict.INFORMATIONAL, "steers straight", "R-drive-steering")
    report = replace(report, results=(*report.results, odd))

    assert "made/odd" not in shown(report)
    assert "steers straight [R-drive-steering]" in shown(report, everything=True)


def test_without_a_probe_it_says_what_was_not_seen_and_what_was_right(unseen: Report) -> None:
    counts = unseen.counts
    words = conclusion(unseen).plain

    left = [r for r in unseen.results if r.verdict is Verdict.INCONCLUSIVE]
    stops = sum(r.axes["stop"].verdict is Verdict.INCONCLUSIVE for r in left if "stop" in r.axes)
    assert stops == 2
    states = len(left) - stops
    assert f"{states} states and 2 stops not seen without a probe" in words
    assert f"{counts['pass']} answers right" in words
    assert "inconclusive" not in words
    assert unseen.exit == 3


def test_what_is_inconclusive_for_another_reason_stays_so(unseen: Report) -> None:
    flaky = replace(
        unseen.results[-1],
        axes={"answer": Axis(Verdict.INCONCLUSIVE, "00 OK", "no answer", "flaky")},
        verdict=Verdict.INCONCLUSIVE,
    )

    assert "1 inconclusive" in conclusion(replace(unseen, results=(*unseen.results, flaky))).plain


def test_no_column_is_cut_off_at_80_columns_or_in_a_file(protocol: Protocol) -> None:
    report = every_verdict(protocol)
    long = a_case("wrong-length/Right/3", Verdict.FAIL)

    text = shown(replace(report, results=(*report.results, long)), width=80)

    head = next(line for line in text.splitlines() if "cases" in line)
    words = ["cases", "skipped", "pass", "info", "non-strict", "inconc", "fail", "error"]
    assert [word for word in head.replace("\u2503", " ").split() if word in words] == words
    assert "\u2026" not in text


def test_a_failed_case_lists_the_axes_that_failed(protocol: Protocol) -> None:
    failed = a_case("made/two", Verdict.FAIL, "the wrong answer")
    reset = Axis(Verdict.NON_STRICT, "moving", "moving", "another reading")
    report = replace(
        every_verdict(protocol), results=(replace(failed, axes=failed.axes | {"state": reset}),)
    )

    assert "the wrong answer" in shown(report)
    assert "another reading" not in shown(report)


PARSER = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])


def tokens(text: str) -> list[Token]:
    return [token for outer in PARSER.parse(text) for token in (outer, *(outer.children or ()))]


def table(text: str) -> list[list[str]]:
    """The cells of the table, row by row, as a reader sees them."""
    found: list[list[str]] = []
    inside = False
    for token in PARSER.parse(text):
        if token.type == "tr_open":
            found.append([])
        elif token.type in ("td_open", "th_open", "td_close", "th_close"):
            inside = token.nesting == 1
        elif token.type == "inline" and inside:
            found[-1].append("".join(child.content for child in token.children or ()))
    return found


def test_what_was_not_judged_is_told_by_reason(protocol: Protocol) -> None:
    results = [a_case(f"x/{n}", Verdict.INCONCLUSIVE, "not observable") for n in range(30)]
    results += [a_case("y/1", Verdict.INCONCLUSIVE, "flaky")]
    text = as_markdown([replace(every_verdict(protocol), results=tuple(results))], protocol)

    assert "- 30 cases, `x/0` is the first: not observable" in text
    assert "- 1 case, `y/1` is the first: flaky" in text


def test_a_long_text_is_cut(protocol: Protocol) -> None:
    report = replace(every_verdict(protocol), device="<|`" * 5000)

    assert len(as_markdown([report], protocol)) < 10_000


@pytest.mark.parametrize("evil", HOSTILE.values(), ids=HOSTILE)
def test_any_foreign_text_is_text(protocol: Protocol, evil: str) -> None:
    text = as_markdown([hostile(protocol, evil)], protocol)
    found = tokens(text)

    kinds = {token.type for token in found}
    assert not kinds & {"link_open", "image", "html_block", "s_open", "em_open", "blockquote_open"}
    assert {t.content for t in found if t.type == "html_inline"} <= {"<!-- -->"}
    # Headings and lists are ours alone.
    headings = [token for token in found if token.type == "heading_open"]
    assert len(headings) == 4
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028\u202e\ud800-\udfff]", text)
    assert {len(row) for row in table(text)} == {3}


@pytest.mark.parametrize(
    "evil", [*HOSTILE.values(), "# x", "- x", "1. x", "12) x", "+ x", "> x", "    x", "==="]
)
def test_prose_reads_as_it_was(evil: str) -> None:
    words = prose(escape_controls(evil))
    for begin in ("", "- "):
        text = f"{begin}{words}"
        outer = [t.type for t in PARSER.parse(text) if t.type.endswith("_open")]
        assert outer == (["bullet_list_open", "list_item_open"] if begin else []) + [
            "paragraph_open"
        ]
    inner = [t for t in tokens(words) if t.type not in ("html_inline", "paragraph_open")]
    assert {t.type for t in inner} <= {"inline", "text", "text_special", "paragraph_close"}


@pytest.mark.parametrize("text", ["a", "`", "``a`", "a ` b", "|", " ", "\\", "a\\|b", "` `` ```"])
def test_code_reads_as_it_was(text: str) -> None:
    rows = table(f"| x | y |\n|---|---|\n| {code(text)} | z |\n")

    assert [cell.strip() for cell in rows[1]] == [text.strip(), "z"]


def test_nobody_is_mentioned_and_nothing_becomes_an_address() -> None:
    assert prose("@all") == "@<!-- -->all"
    assert prose("see www.x.org, http://y") == "see www<!-- -->.x.org, http://<!-- -->y"


def test_the_page_begins_with_what_to_mend_and_ends_with_the_facts(protocol: Protocol) -> None:
    report = a_run(protocol, "bad-data/LED/[89]", fault="no-stop-on-bad-data")
    page = as_html([report], protocol)
    [cause] = report.causes
    parts = ("Causes", cause.sentence, "Matrix by clause", ">Coverage</h2>", "<dt>seed")
    places = [page.index(part) for part in parts]
    assert places == sorted(places)
    assert "LED rgb=8 (faulty, 02 BAD_DATA is due)" in page
    assert f">{cause.shown}<" in page
    assert cause.shown == "motion is backward, expected stopped"
    assert all(f"#case={ident}" in page for ident in cause.cases)


# -- wire log entries in words ---------------------------------------------------------------------


def sent(hex: str, t: int = 0) -> WireEvent:
    return WireEvent(t / 1e3, "sent", hex)


def words(protocol: Protocol, *log: WireEvent, **profile: float | None) -> list[str]:
    report = replace(every_verdict(protocol), profile=Figures(**profile))
    return list(WireWords(protocol, report).of(log))


def test_a_frame_that_comes_in_parts_is_one_frame(protocol: Protocol) -> None:
    assert words(protocol, sent("11"), sent("05", 49), sent("20", 50)) == [
        "Speed, 0 of 1 data byte so far",
        "(goes on), Speed speed=5",
        "Forward",
    ]


def test_after_the_time_out_a_byte_is_a_header_again(protocol: Protocol) -> None:
    log = (sent("11"), sent("20", 30))

    for measured in ({}, {"truncation_timeout_ms": None}, {"truncation_timeout_ms": 0}):
        assert words(protocol, *log, **measured)[1] == "(goes on), Speed speed=32"
    assert words(protocol, *log, truncation_timeout_ms=25.0)[1] == "Forward"
    assert words(protocol, sent("11"), sent("20", 60))[1] == "Forward"


def test_the_answer_to_a_frame_cut_short_may_come_before_its_time_out_was_noted(
    protocol: Protocol,
) -> None:
    answers = WireEvent(0.045, "received", "00 00 04 2a")

    told = ["2 × 00 OK, 04 TOO_FEW_DATA, 2a unused", "Forward"]
    assert words(protocol, sent("11"), answers, sent("20", 46))[1:] == told


def test_another_grammar_has_its_own_words_and_foreign_bytes_have_none(
    protocol: Protocol, horn: Protocol
) -> None:
    report = replace(every_verdict(protocol), grammar=Grammar("horn", "1", horn.sha256, ""))

    assert list(WireWords(horn, report).of([sent("91 02")])) == ["Horn sound=2"]
    assert list(WireWords(protocol, report).of([sent("91 02")])) == [""]
