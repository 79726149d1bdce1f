"""Writes reports as JUnit XML; a case that was not judged is skipped, with its reason."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.report.grouping import by_group
from bilprov.conformance.report.run_report import Report, conclusion, evidence_lines, run_facts
from bilprov.spec.protocol import Protocol

_NOT_RUN = "run"
_CAUSES = "causes"


def as_junit(reports: Sequence[Report], protocol: Protocol) -> str:
    """JUnit XML with one test suite for each first part of the ids, one test case for each case.

    A failure is a `failure` (with `--strict` non-strict is one too), an error an `error`;
    inconclusive and skipped are `skipped` with their reason; the other verdicts pass, with verdict
    and reading in the properties and, unless it is `pass`, in `system-out`. Times are seconds on
    the wire. The first suite has no test cases, but the causes of what failed. With several reports
    the device's name stands before that of each suite and class. A run in which nothing could be
    judged has one test case more, an error.
    """
    root = Element("testsuites", name="bilprov conform")
    for report in reports:
        before = f"{report.device}: " if len(reports) > 1 else ""
        if report.causes:
            suite = _suite(root, report, before + _CAUSES)
            SubElement(suite, "system-out").text = "\n".join(_causes(report))
        for name, results in by_group(report.results).items():
            suite = _suite(root, report, before + name)
            for result in results:
                _case(suite, report, result, before)
        if report.unusable:
            suite = _suite(root, report, before + _NOT_RUN)
            classname = before + _NOT_RUN
            case = SubElement(suite, "testcase", classname=classname, name="usable", time="0")
            SubElement(case, "error", type="error", message=report.unusable)
    for suite in root:
        for kind, tag in (("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
            suite.set(kind, str(len(suite.findall(f"testcase/{tag}"))))
        cases = suite.findall("testcase")
        suite.set("tests", str(len(cases)))
        suite.set("time", f"{sum(float(case.get('time', 0)) for case in cases):.6f}")
    for total in ("tests", "failures", "errors", "skipped"):
        root.set(total, str(sum(int(suite.get(total, 0)) for suite in root)))
    root.set("time", f"{sum(float(suite.get('time', 0)) for suite in root):.6f}")
    indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, "unicode") + "\n"


def _causes(report: Report) -> Iterator[str]:
    """The causes of what failed, each with the line that shows it."""
    for cause in report.causes:
        yield f"{cause.sentence}  {cause.clause}"
        yield f"again     {report.send_line(cause)}"
        if cause.shown:
            yield f"shows     {cause.shown}"


def _suite(root: Element, report: Report, name: str) -> Element:
    suite = SubElement(root, "testsuite", name=name)
    if report.begun:
        suite.set("timestamp", report.begun)
    if report.host:
        suite.set("hostname", report.host)
    properties = SubElement(suite, "properties")
    grammar = report.grammar
    facts = {
        "device": report.device,
        "conclusion": conclusion(report).plain,
        "seed": str(report.seed),
        "kit": report.kit,
        "grammar": f"{grammar.name} {grammar.version} {grammar.sha256}",
    }
    facts |= run_facts(report)
    for key, value in facts.items():
        SubElement(properties, "property", name=key, value=value)
    return suite


def _case(suite: Element, report: Report, result: CaseResult, before: str) -> None:
    seconds = result.log[-1].t if result.log else 0
    case = SubElement(
        suite,
        "testcase",
        classname=before + result.planned_clause,
        name=result.id,
        time=f"{seconds:.6f}",
    )
    properties = SubElement(case, "properties")
    for key, value in (("verdict", result.verdict.label), ("reading", result.reading)):
        if value:
            SubElement(properties, "property", name=key, value=value)
    if result.verdict is Verdict.PASS:
        return
    head = f"{result.verdict.label} ({result.clause}): {result.requirement}"
    words = "\n".join([head, *evidence_lines(result, result.reproduce)])
    reason = result.reason or result.verdict.label
    tag = outcome(result.verdict, strict=report.options.strict)
    if tag == "skipped":
        SubElement(case, tag, type=result.verdict.label, message=reason)
    elif tag:
        SubElement(case, tag, type=result.verdict.label, message=reason).text = words
        return
    SubElement(case, "system-out").text = words


def outcome(verdict: Verdict, *, strict: bool) -> str:
    """The name of the element that reports a verdict, "" for a test that passed."""
    if verdict is Verdict.ERROR:
        return "error"
    if verdict is Verdict.FAIL or (strict and verdict is Verdict.NON_STRICT):
        return "failure"
    return "skipped" if verdict in (Verdict.INCONCLUSIVE, Verdict.SKIPPED) else ""
