"""The summary on a terminal: what is listed, and the line that says how the run ended."""

from __future__ import annotations

from io import StringIO

import pytest
from msgspec.structs import replace
from rich.console import Console

from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.report.run_report import Report, conclusion
from bilprov.conformance.report.summary import show
from bilprov.spec.protocol import Protocol
from tests.support.reports import a_case, a_run, every_verdict


def shown(report: Report, *, everything: bool = False) -> str:
    text = StringIO()
    show(report, Console(file=text, width=200), everything=everything)
    return text.getvalue()


class Blind:
    """A device object whose robot nothing sees."""

    def __init__(self, device: Simulator) -> None:
        self.receive, self.advance, self.deadline = device.receive, device.advance, device.deadline


@pytest.fixture
def unseen(protocol: Protocol) -> Report:
    options = Options(only=("bad-data/LED/9", "valid/LED/1", "truncated/Right/0"))
    report = conform(Blind(Simulator(protocol)), grammar=protocol, options=options)
    assert report.link["probe"] == "none"
    return report


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


def test_with_a_probe_the_verdicts_are_counted(protocol: Protocol) -> None:
    words = conclusion(a_run(protocol, "valid/LED/1")).plain

    assert "pass" in words
    assert "answers right" not in words


def test_the_reason_why_nothing_could_be_judged_stands_first(protocol: Protocol) -> None:
    report = replace(every_verdict(protocol), unusable="nobody answered in 10 s", results=())

    assert shown(report) == "not judged: nobody answered in 10 s\n"


def test_no_column_is_cut_off_at_80_columns_or_in_a_file(protocol: Protocol) -> None:
    report = every_verdict(protocol)
    long = a_case("wrong-length/Right/3", Verdict.FAIL)
    text = StringIO()

    show(replace(report, results=(*report.results, long)), Console(file=text, width=80))

    head = next(line for line in text.getvalue().splitlines() if "cases" in line)
    words = ["cases", "skipped", "pass", "info", "non-strict", "inconc", "fail", "error"]
    assert [word for word in head.replace("\u2503", " ").split() if word in words] == words
    assert "\u2026" not in text.getvalue()


def test_a_failed_case_lists_the_axes_that_failed(protocol: Protocol) -> None:
    failed = a_case("made/two", Verdict.FAIL, "the wrong answer")
    reset = Axis(Verdict.NON_STRICT, "moving", "moving", "another reading")
    report = replace(
        every_verdict(protocol), results=(replace(failed, axes=failed.axes | {"state": reset}),)
    )

    assert "the wrong answer" in shown(report)
    assert "another reading" not in shown(report)
