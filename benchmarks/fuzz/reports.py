"""The target that merges reports of shards."""

from __future__ import annotations

import io
import json
from collections.abc import Hashable
from functools import cache

from rich.console import Console

from benchmarks.fuzz.engine import Target, Test, Wrong, folder, require
from benchmarks.fuzz.mutators import json_mutator
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.conformance.api import Options, conform
from bilprov.conformance.oracle.verdicts import LABELS
from bilprov.conformance.report.json_report import ReportError, as_json, read_report
from bilprov.conformance.report.merge import MergeError, merge, require_together, shard_from
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.report.summary import show, show_compared

_CASES = 4  # of a seed


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


@cache
def _shards() -> list[bytes]:
    """The reports of the two shards of a short run."""
    only = ("wrong-length/*/0", "bad-data/*")
    options = [Options(level="smoke", only=only, shard=(number, 2)) for number in (1, 2)]
    return [_short(as_json(conform(options=each))) for each in options]


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


TARGETS = (
    Target(
        "merge",
        "reports of shards",
        merging,
        (MergeError, ReportError),
        _shards,
        json_mutator(tuple(LABELS)),
        2.4,
    ),
)
