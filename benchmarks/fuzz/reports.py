"""Targets that read reports of runs, and files of expected failures."""

from __future__ import annotations

import io
import json
from collections.abc import Hashable
from functools import cache
from xml.etree import ElementTree

from msgspec.structs import replace
from rich.console import Console

from benchmarks.fuzz.engine import Target, Test, Wrong, folder, require
from benchmarks.fuzz.mutators import json_mutator, text_mutator
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.oracle.verdicts import LABELS
from bilprov.conformance.report.expected import ExpectedError, parse_expected
from bilprov.conformance.report.expected_file import ExpectedFile
from bilprov.conformance.report.html.page import as_html
from bilprov.conformance.report.json_report import ReportError, as_json, read_report
from bilprov.conformance.report.junit import as_junit
from bilprov.conformance.report.markdown import as_markdown
from bilprov.conformance.report.merge import MergeError, merge, require_together, shard_from
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.report.summary import show, show_compared

_CASES = 4  # of a seed


@cache
def _reports() -> tuple[Report, ...]:
    """Reports of short runs: of a good device, of a faulty one, and the two shards of one run."""
    protocol = load_protocol()
    bank = list(fault_bank(protocol).values())
    only = ("wrong-length/*/0", "bad-data/*")
    return (
        conform(Simulator(protocol), options=Options(level="smoke", only=only)),
        conform(Simulator(protocol, bank[0]), options=Options(level="smoke", only=only)),
        *(
            conform(Simulator(protocol), options=Options(level="smoke", only=only, shard=(n, 2)))
            for n in (1, 2)
        ),
    )


def _short(data: bytes) -> bytes:
    """A report with few of its cases, and the counts of those."""
    document = json.loads(data)
    document["cases"] = document["cases"][:_CASES]
    for case in document["cases"]:
        case["log"] = case["log"][:3]
    labels = [case["verdict"] for case in document["cases"]]
    document["counts"] = {label: labels.count(label) for label in document["counts"]}
    document["verdict"] = max(labels, key=lambda label: LABELS[label])
    return json.dumps(document).encode()


def _seeds() -> list[bytes]:
    return [_short(as_json(report)) for report in _reports()[:2]]


def _shards() -> list[bytes]:
    return [_short(as_json(report)) for report in _reports()[2:]]


def report() -> Test:
    """A report from a file is refused, or written in every form, and read back as the same."""
    protocol = load_protocol()
    path, again = folder() / "report.json", folder() / "again.json"

    def test(data: bytes) -> Hashable:
        path.write_bytes(data)
        found = read_report(str(path))
        again.write_bytes(as_json(found))
        same = replace(read_report(str(again)), again=found.again)
        require(same == found, "a report is read back as another one")
        require("</html>" in as_html([found, found], protocol), "half a page")
        ElementTree.fromstring(as_junit([found], protocol))
        as_markdown([found], protocol).encode()
        _show(found)
        return found.exit, len(found.results), found.proof is None

    return test


def _show(found: Report) -> None:
    out = io.StringIO()
    console = Console(file=out, highlight=False, soft_wrap=True)
    show(found, console, everything=True)
    show_compared([found] * 2, console, everything=True)
    out.getvalue().encode()


def merging() -> Test:
    """Shards are refused, or merged into a report that can be written and read."""
    protocol = load_protocol()
    path, one = folder() / "merged.json", folder() / "one.json"
    other = shard_from("other.json", _shards()[1])

    def test(data: bytes) -> Hashable:
        part = shard_from("one.json", data)
        parts = [part, other]
        require_together(parts, protocol)
        merged = merge(parts, protocol, ())
        path.write_bytes(merged.as_json(merged.report))
        _show(merged.report)
        one.write_bytes(data)
        read_report(str(one))  # refuses what a merge leaves as it is, as wire logs
        try:
            again = read_report(str(path))
        except ReportError as error:
            raise Wrong("what was merged cannot be read") from error
        require(again.exit == merged.report.exit, "it is read back as another")
        return part.index, part.of, merged.report.exit

    return test


def expected() -> Test:
    """A file of expected failures is refused, or compared with a report and written anew."""
    faulty = _reports()[1]
    suite = [result.id for result in faulty.results]
    path = folder() / "expected.txt"

    def test(data: bytes) -> Hashable:
        path.write_bytes(data)
        file = ExpectedFile(str(path), lambda: suite, suite, update=data[-1:] == b"\n")
        found, change = file.applied(faulty)
        if change is not None:
            entries = parse_expected(path.read_text(encoding="utf-8"), "again")
            require(not found.comparison or not found.comparison.unexpected, "some stay unexpected")
            return len(entries), len(change.added), len(change.removed)
        return found.exit, found.comparison and len(found.comparison.stale)

    return test


_EXPECTED = [
    b"# a comment\nbad-data/* : answer: 00 OK\n",
    b"wrong-length/* : answer: no answer came\n\nbad-data/[LS]*/? : stop: ",
    b"*/* : state: speed is 3\r\nreading/* : answer: x : y\n",
]
_WORDS = ("*", "?", "[a-z]", "[!", "**", " : ", "#", "answer: ", "stop: ", "bad-data/", "/", "\n")

TARGETS = (
    Target(
        "report",
        "reports, and what is made of them",
        report,
        (ReportError,),
        _seeds,
        json_mutator(tuple(LABELS)),
        0.8,
    ),
    Target(
        "merge",
        "reports of shards",
        merging,
        (MergeError, ReportError),
        _shards,
        json_mutator(tuple(LABELS)),
        2.4,
    ),
    Target(
        "expected",
        "expected failures",
        expected,
        (ExpectedError,),
        lambda: _EXPECTED,
        text_mutator(_WORDS),
        3,
    ),
)
