"""The formats that a report is written in, as one table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from bilprov.conformance.report.html.page import as_html
from bilprov.conformance.report.json_report import as_json
from bilprov.conformance.report.junit import as_junit
from bilprov.conformance.report.markdown import as_markdown
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol

Writer = Callable[[Sequence[Report], Protocol], str]


class Format(NamedTuple):
    """One format: its option's help text, its writer, and whether it takes several reports."""

    help: str
    write: Writer
    several: bool = True


# Each format's option is its name with two dashes.
FORMATS = {
    "json": Format(
        "The report as JSON; - is standard output.",
        lambda reports, protocol: as_json(*reports).decode(),
        several=False,
    ),
    "junit": Format("JUnit XML, for a CI's list of tests.", as_junit),
    "markdown": Format("A summary for a CI's page.", as_markdown),
    "html": Format("One page with matrix, wire logs and timing pictures.", as_html),
}
SEVERAL = tuple(name for name, form in FORMATS.items() if form.several)
