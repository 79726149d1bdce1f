"""The target that reads reports of runs."""

from __future__ import annotations

import io
from collections.abc import Hashable

from rich.console import Console

from benchmarks.fuzz.engine import Target, Test, require
from benchmarks.fuzz.mutators import json_mutator
from bilprov.conformance.api import Options, conform
from bilprov.conformance.oracle.verdicts import LABELS
from bilprov.conformance.report.json_report import ReportError, as_json, parse_report
from bilprov.conformance.report.summary import show, show_compared


def reports() -> Test:
    """A report is refused, or shown, compared and written again as the same report."""

    def test(data: bytes) -> Hashable:
        report = parse_report(data, "one.json")
        console = Console(file=io.StringIO(), highlight=False, soft_wrap=True)
        show(report, console, everything=True)
        show_compared([report] * 2, console, everything=True)
        again = parse_report(as_json(report), "again.json")
        require(again.results == report.results, "it is read back as another")
        return report.exit, len(report.results)

    return test


def _seeds() -> list[bytes]:
    only = ("valid/LED/[01]", "bad-data/LED/9")
    return [as_json(conform(options=Options(only=(glob,)))) for glob in only]


TARGETS = (Target("report", reports, (ReportError,), _seeds, json_mutator(tuple(LABELS)), 2.4),)
