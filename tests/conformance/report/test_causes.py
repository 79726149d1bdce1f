"""The causes of a run in each form of its report: they come before the cases."""

from __future__ import annotations

from xml.etree.ElementTree import fromstring

import pytest

from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.report.html.page import as_html
from bilprov.conformance.report.json_report import as_json, parse_report
from bilprov.conformance.report.junit import as_junit
from bilprov.conformance.report.markdown import as_markdown
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol

LINE = "bilprov send PORT '11 c9' 60 '81 08'"


@pytest.fixture(scope="module")
def report(protocol: Protocol) -> Report:
    fault = fault_bank(protocol)["no-stop-on-bad-data"]
    return conform(Simulator(protocol, fault), options=Options(level="smoke"))


def test_the_page_begins_with_what_to_mend_and_ends_with_the_facts(
    report: Report, protocol: Protocol
) -> None:
    page = as_html([report], protocol)
    [cause] = report.causes
    places = [
        page.index(part)
        for part in (
            "Causes",
            cause.sentence,
            "Matrix by clause",
            ">Coverage</h2>",
            "<dt>seed",
        )
    ]
    assert places == sorted(places)
    assert "LED rgb=8 (faulty, 02 BAD_DATA is due)" in page
    assert all(f"#case={ident}" in page for ident in cause.cases)


def test_markdown_names_the_cause_before_the_table(report: Report, protocol: Protocol) -> None:
    text = as_markdown([report], protocol)
    assert text.index("Causes") < text.index(LINE) < text.index("| cases |")


def test_the_first_suite_of_junit_has_the_causes_and_counts_nothing(
    report: Report, protocol: Protocol
) -> None:
    root = fromstring(as_junit([report], protocol))
    assert root[0].get("name") == "causes"
    assert root[0].get("tests") == "0"
    assert LINE in str(root[0].findtext("system-out"))
    assert root.get("failures") == str(report.counts["fail"])


def test_json_keeps_the_causes(report: Report) -> None:
    again = parse_report(as_json(report), "r.json")
    assert again.causes == report.causes
    assert again.causes[0].log
    assert again.unexplained == 0
