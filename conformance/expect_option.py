"""`--expect-failures` and `--update-expected`: click's values in, a file to apply out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import rich_click as click

from analyzer.options import note
from captures.errors import shown
from conformance.api import Options, suite_ids
from conformance.cases.levels import DEEP
from conformance.report.expected_file import ExpectedFile
from conformance.report.run_report import Report
from spec.protocol import Protocol

_SHOWN = 8  # changed lines
Command = TypeVar("Command", bound=Callable[..., Any])


def expect_failures_option(command: Command) -> Command:
    """`--expect-failures FILE`, as `expect_failures`."""
    return click.option(
        "--expect-failures",
        metavar="FILE",
        help="Failures that do not count: lines of GLOB : MESSAGE, a glob of case ids and how the "
        "failure begins (answer: no answer came); # begins a comment. One that no longer fails is "
        "itself a failure.",
    )(command)


def update_expected_option(command: Command) -> Command:
    """`--update-expected`, as `update_expected`."""
    return click.option(
        "--update-expected",
        is_flag=True,
        help="Write that file anew from what fails now; comments stay.",
    )(command)


def expected_file(
    protocol: Protocol,
    options: Options,
    path: str | None,
    *,
    update: bool = False,
) -> ExpectedFile | None:
    """The file of expected failures, None where none was given.

    A file may be used for every level: what only the deep one has is known too.
    Raises ExpectedError, and UsageError for an update of no file.
    """
    if path is None:
        if update:
            raise click.UsageError("--update-expected needs --expect-failures FILE to write")
        return None
    known = suite_ids(protocol, replace(options, level=DEEP.name))
    suite = suite_ids(protocol, options)
    return ExpectedFile(path, dict.fromkeys(known), dict.fromkeys(suite), update=update)


def with_expected(report: Report, file: ExpectedFile | None, path: str | None) -> Report:
    """The report with what the file says about it; what was changed in the file is said."""
    if file is None:
        return report
    compared, change = file.applied(report)
    if change is not None:
        for sign, lines in (("-", change.removed), ("+", change.added)):
            for line in lines[:_SHOWN]:
                note(f"{sign} {shown(line)}")
            if len(lines) > _SHOWN:
                note(f"{sign} and {len(lines) - _SHOWN} more")
        added, removed = len(change.added), len(change.removed)
        note(f"{path}: {added} added, {removed} removed" if added + removed else f"{path} fits")
    return compared
