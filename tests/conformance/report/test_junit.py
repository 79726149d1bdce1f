"""JUnit XML, read back by a public parser: totals, outcomes, and any bytes of a device."""

from __future__ import annotations

import re
from xml.etree.ElementTree import fromstring

import junitparser
import pytest
from msgspec.structs import replace

from bilprov.captures.text import escape_controls
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.junit import as_junit, outcome
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol
from tests.support.reports import a_case, every_verdict, hostile
from tests.support.surfaces import HOSTILE


def parsed(reports: list[Report], protocol: Protocol) -> junitparser.JUnitXml:
    return junitparser.JUnitXml.fromstring(as_junit(reports, protocol).encode())


def cases(xml: junitparser.JUnitXml) -> dict[str, junitparser.TestCase]:
    return {case.name: case for suite in xml for case in suite}


@pytest.mark.parametrize(
    ("verdict", "strict", "kind"),
    [
        (Verdict.PASS, False, ""),
        (Verdict.INFORMATIONAL, False, ""),
        (Verdict.INFORMATIONAL, True, ""),
        (Verdict.NON_STRICT, False, ""),
        (Verdict.NON_STRICT, True, "failure"),
        (Verdict.INCONCLUSIVE, False, "skipped"),
        (Verdict.INCONCLUSIVE, True, "skipped"),
        (Verdict.SKIPPED, False, "skipped"),
        (Verdict.FAIL, False, "failure"),
        (Verdict.ERROR, False, "error"),
    ],
)
def test_each_verdict_has_its_outcome(
    protocol: Protocol, verdict: Verdict, strict: bool, kind: str
) -> None:
    case = cases(parsed([every_verdict(protocol, strict=strict)], protocol))[
        f"made/{verdict.label}"
    ]

    assert outcome(verdict, strict=strict) == kind
    assert [type(result).__name__.lower() for result in case.result] == ([kind] if kind else [])
    for result in case.result:
        assert result.message == "a reason"
        assert result.type == verdict.label


def test_what_is_no_plain_pass_says_its_verdict_reading_and_how_to_try_it_again(
    protocol: Protocol,
) -> None:
    case = replace(a_case("one/1", Verdict.NON_STRICT, "slow", "R-led-id"), reproduce="do it again")
    report = replace(every_verdict(protocol), results=(case,))
    found = cases(parsed([report], protocol))["one/1"]
    properties = {p.name: p.value for p in found.child(junitparser.Properties)}

    assert properties == {"verdict": "non-strict", "reading": "R-led-id"}
    for words in ("slow", "[R-led-id]", "00 OK", "01 BAD_HEADER", "11 7f", "do it again"):
        assert words in found.system_out
    assert "expected  stopped" not in found.system_out  # an axis that passed


def test_an_unusable_line_is_an_error_and_never_an_empty_success(protocol: Protocol) -> None:
    report = replace(every_verdict(protocol), results=(), unusable="the line is an echo")
    xml = parsed([report], protocol)

    assert (xml.tests, xml.errors) == (1, 1)
    (error,) = cases(xml)["usable"].result
    assert error.message == "the line is an echo"


@pytest.mark.parametrize("evil", HOSTILE.values(), ids=HOSTILE)
def test_any_foreign_text_is_text(protocol: Protocol, evil: str) -> None:
    written = as_junit([hostile(protocol, evil)], protocol)
    root = fromstring(written)  # our own text

    assert {element.tag for element in root.iter()} == {
        "testsuites", "testsuite", "properties", "property", "testcase", "failure", "skipped",
        "system-out",
    }  # fmt: skip
    assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\ufffe]", written)
    xml = parsed([hostile(protocol, evil)], protocol)
    assert (xml.tests, xml.failures, xml.skipped) == (2, 1, 1)
    assert all(escape_controls(evil)[:5] in case.name for case in cases(xml).values())
