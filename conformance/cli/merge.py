"""`bilprov merge`: puts the JSON reports of `conform --shard` together into one."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import rich_click as click
from rich.console import Console

from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.analyzer.files import replace_file
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.line_settings import line_named
from bilprov.captures.text import printable
from bilprov.conformance.api import Options, select_cases
from bilprov.conformance.cases.levels import LEVELS
from bilprov.conformance.cli.options import expect_failures_option, expected_file, with_expected
from bilprov.conformance.report.merge import merge
from bilprov.conformance.report.run_report import Report, expected_failures
from bilprov.conformance.report.shard import MergeError, ShardReport, require_together, shard_from
from bilprov.conformance.report.summary import show, visible_report

_MOST = 1 << 28  # bytes of a report


@click.command(name="merge")
@click.argument("files", nargs=-1, required=True, metavar="REPORT.json...")
@click.option(
    "--json", "json_path", metavar="FILE", help="The whole as JSON; - is standard output."
)
@expect_failures_option
@click.option("-v", "--verbose", is_flag=True, help="List every case that did not pass.")
@click.pass_obj
def merge_reports(
    grammar: str | None,
    files: tuple[str, ...],
    json_path: str | None,
    expect_failures: str | None,
    verbose: bool,
) -> int:
    """Put the reports of shards together, as if it had been one run.

    Each REPORT.json is what `conform --shard I/N --json` wrote. They must be of the same grammar,
    seed and options; the devices may be several of a kind. The cases that open each run count once.
    Exit code: as conform; 3 also when a shard is missing and nothing failed.
    """
    promise_verdict()
    protocol = load_protocol(grammar)
    parts = [shard_from(name, _read(name)) for name in files]
    require_together(parts, protocol)
    options, line = _options(parts[0]), line_named(protocol, parts[0].told.link.line)
    known = expected_file(protocol, options, expect_failures, line)
    _require_new(json_path, files)
    try:
        cases = select_cases(protocol, options, line)
    except ValueError as error:
        raise MergeError(f"{parts[0].name}: {error}") from error
    merged = merge(parts, protocol, cases)
    report = with_expected(merged.report, known, expect_failures)
    console = Console(stderr=json_path == "-", highlight=False, soft_wrap=True)
    try:
        _write(json_path, _as_json(report, merged.document))
    finally:
        show(visible_report(report), console, everything=verbose)
    return report.exit


def _as_json(report: Report, document: dict[str, Any]) -> bytes:
    """The merged JSON, with the comparison with a file of expected failures, if there is one."""
    if report.comparison:
        known = report.comparison.expected
        document = document | {
            "exit": report.exit,
            "expected_failures": expected_failures(report.comparison),
            "cases": [c | {"expected_failure": c["id"] in known} for c in document["cases"]],
        }
    return msgspec.json.format(msgspec.json.encode(document), indent=1) + b"\n"


def _options(part: ShardReport) -> Options:
    """The run's options without the shard, from its report. Raises MergeError."""
    try:
        options = replace(msgspec.convert(part.told.options, Options), shard=None)
    except msgspec.ValidationError as error:
        raise MergeError(
            f"{part.name} tells options that there are not ({printable(error)})"
        ) from error
    if options.level not in LEVELS:
        raise MergeError(
            f"{part.name} tells a level that there is not: {printable(options.level)!r}; there are "
            f"{', '.join(LEVELS)}"
        )
    return options


def _read(name: str) -> bytes:
    path = Path(name)
    try:
        if path.exists() and not path.is_file():
            raise MergeError(
                f"{printable(name)} is no regular file; name what conform --json wrote"
            )
        with path.open("rb") as file:
            data = file.read(_MOST + 1)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or "no file can have this name"
        raise MergeError(f"{printable(name)} cannot be read ({why})") from error
    if len(data) > _MOST:
        raise MergeError(f"{printable(name)} is larger than 256 MiB: that is no report")
    return data


def _require_new(path: str | None, files: tuple[str, ...]) -> None:
    """Raise UsageError for a result that cannot be written, or would replace one of the reports."""
    if path in (None, "-"):
        return
    file = Path(str(path))
    if file.is_dir() or not file.absolute().parent.is_dir():
        raise click.UsageError(
            f"--json {path} cannot be written: name a file in a folder that exists"
        )
    if file.resolve() in [Path(name).resolve() for name in files]:
        raise click.UsageError(f"--json {path} is one of the reports that are merged: name another")


def _write(path: str | None, data: bytes) -> None:
    if path == "-":
        sys.stdout.write(data.decode())
        sys.stdout.flush()
    elif path is not None:
        replace_file(Path(path), data)
