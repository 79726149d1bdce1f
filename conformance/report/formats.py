"""The formats that a report is written in, as one table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import NamedTuple

from bilprov.conformance.report.run_report import Report, as_json
from bilprov.spec.protocol import Protocol

Writer = Callable[[Sequence[Report], Protocol], str]


class Format(NamedTuple):
    """One format: its option, its help text, and the module and name of its writer."""

    option: str
    help: str
    module: str
    writer: str


FORMATS = {
    "json": Format(
        "--json",
        "The report as JSON, for machines.",
        "bilprov.conformance.report.formats",
        "_as_json",
    ),
    "junit": Format(
        "--junit",
        "JUnit XML, for a CI's list of tests.",
        "bilprov.conformance.report.junit",
        "as_junit",
    ),
    "markdown": Format(
        "--markdown",
        "A summary for a CI's page.",
        "bilprov.conformance.report.markdown",
        "as_markdown",
    ),
    "html": Format(
        "--html",
        "One page with matrix, wire logs and timing pictures.",
        "bilprov.conformance.report.html.page",
        "as_html",
    ),
}


def writer_of(form: Format) -> Writer:
    """The function that writes reports in a format; its module is imported when it is called."""

    def write(reports: Sequence[Report], protocol: Protocol) -> str:
        written: str = getattr(import_module(form.module), form.writer)(reports, protocol)
        return written

    return write


def _as_json(reports: Sequence[Report], protocol: Protocol) -> str:
    (report,) = reports
    return as_json(report).decode()
