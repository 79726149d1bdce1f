"""`bilprov merge`: puts the JSON reports of `conform --shard` together into one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec

from bilprov.analyzer.cli.command import argument, command, protocol_in_use
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.analyzer.transport.line_settings import line_named
from bilprov.conformance.api import Options, select_cases
from bilprov.conformance.cases.levels import LEVELS
from bilprov.conformance.cli.options import (
    expect_failures_option,
    expected_file,
    verbose_option,
    with_expected,
)
from bilprov.conformance.cli.outputs import (
    onto_standard_output,
    outputs_of,
    outputs_option,
    require_writable,
    write_each,
)
from bilprov.conformance.report.json_report import report_file
from bilprov.conformance.report.merge import (
    MergeError,
    ShardReport,
    require_together,
    shard_from,
)
from bilprov.conformance.report.merge import merge as merged_report


@dataclass(frozen=True)
class MergeOptions:
    """The options of `merge`."""

    files: tuple[str, ...] = argument(nargs=-1, required=True, metavar="REPORT.json...")
    outputs: dict[str, str] = outputs_option(
        ["json"], "The merged report as JSON; - is standard output."
    )
    expect_failures: str | None = expect_failures_option()
    verbose: bool = verbose_option()


@command(MergeOptions)
def merge(options: MergeOptions) -> int:
    """Examples:
      bilprov merge shard1.json shard2.json --json whole.json

    Each REPORT.json is what `conform --shard I/N --json` wrote. They must be of the same grammar,
    seed and options; the devices may be several of a kind. The cases that open each run count once.
    Exit code: as conform; 3 also when a shard is missing and nothing failed.
    """
    from bilprov.conformance.report.summary import show, summary_console

    promise_verdict()
    outputs = outputs_of(options.outputs)
    require_writable(outputs, inputs=options.files)
    protocol = protocol_in_use()
    parts = [shard_from(name, report_file(name)) for name in options.files]
    require_together(parts, protocol)
    run, line = _options(parts[0]), line_named(protocol, parts[0].report.link["line"])
    known = expected_file(protocol, run, options.expect_failures, line)
    try:
        cases = select_cases(protocol, run, line)
    except ValueError as error:
        raise MergeError(f"{parts[0].name}: {error}") from error
    merged = merged_report(parts, protocol, cases)
    report = with_expected(merged.report, known, options.expect_failures)
    console = summary_console(stderr=onto_standard_output(outputs))
    try:
        text = merged.as_json(report).decode()
        write_each((output.path, text) for output in outputs)
    finally:
        show(report, console, everything=options.verbose)
    return report.exit


def _options(part: ShardReport) -> Options:
    """The run's options without the shard, from its report. Raises MergeError."""
    try:
        options = replace(msgspec.convert(part.report.options, Options), shard=None)
    except msgspec.ValidationError as error:
        raise MergeError(f"{part.name} names options that are unknown ({error})") from error
    if options.level not in LEVELS:
        raise MergeError(
            f"{part.name} names an unknown level: {options.level!r}; there are {', '.join(LEVELS)}"
        )
    return options
