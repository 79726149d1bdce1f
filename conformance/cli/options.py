"""Options that several commands share: `--fault`, `--variant`, profile, expected failures.

A shell completes the named faults and variants. What makes and selects cases is imported by the
functions that need it: `simulate` needs none.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from bilprov.analyzer.cli.command import flag, option
from bilprov.analyzer.cli.options import note
from bilprov.analyzer.files import read_bounded
from bilprov.analyzer.grammar_file import load_protocol

if TYPE_CHECKING:
    from bilprov.conformance.api import Options
    from bilprov.conformance.dut.simulator import Fault
    from bilprov.conformance.report.expected import ExpectedFile
    from bilprov.conformance.report.run_report import Report
    from bilprov.spec.protocol import Protocol


def complete_faults(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """The named faults that begin so."""
    from bilprov.conformance.mutation.faults import fault_bank

    return [name for name in fault_bank(load_protocol(ctx.obj)) if name.startswith(incomplete)]


def complete_variants(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """The legal variants that begin so."""
    from bilprov.conformance.mutation.variants import variants as known

    return [name for name in known(load_protocol(ctx.obj)) if name.startswith(incomplete)]


def named_device(protocol: Protocol, fault: str | None, variant: str | None) -> Fault | None:
    """The device that the options name, None for none. Raises UsageError, in one sentence."""
    if fault is not None and variant is not None:
        raise click.UsageError("--fault and --variant are two devices: give one of them")
    if fault is None and variant is None:
        return None
    from bilprov.conformance.mutation.catalogue import find_fault, find_variant

    try:
        if variant is not None:
            return find_variant(protocol, variant)
        assert fault is not None
        return find_fault(protocol, fault)
    except ValueError as error:
        raise click.UsageError(str(error)) from error


_PROFILE_BYTES = 1 << 20


def read_profile(protocol: Protocol, path: str | None, allow: tuple[str, ...]) -> str:
    """The text of a profile, "" where none is asked for or its file does not exist yet.

    Raises click's UsageError, in one sentence, for one that does not fit or cannot be written.
    """
    if path is None:
        return ""
    from bilprov.conformance.oracle.choices import parse_allowed
    from bilprov.conformance.oracle.profile import profile_from

    file = Path(path)
    try:
        if not file.exists() and file.absolute().parent.is_dir():
            return ""
        text = read_bounded(file, _PROFILE_BYTES).decode("utf-8")
        profile_from(protocol, text, parse_allowed(protocol, allow))
    except (OSError, ValueError) as error:
        why = error.strerror or error if isinstance(error, OSError) else error
        raise click.UsageError(f"--profile {path} cannot be used: {why}") from error
    return text


# Options of several commands.
expect_failures_option = partial(
    option,
    metavar="FILE",
    help="Failures that do not count: lines of GLOB : AXIS: MESSAGE, a glob of case ids, the axis "
    "that fails (answer, stop, state) and, optionally, the message; # begins a comment. One that "
    "no longer fails is itself a failure.",
)
seed_option = partial(option, type=int, default=1)
fault_option = partial(option, metavar="NAME", shell_complete=complete_faults)
variant_option = partial(option, metavar="NAME", shell_complete=complete_variants)
verbose_option = partial(flag, "List every case that did not pass.", "-v", "--verbose")


def expected_file(
    protocol: Protocol,
    options: Options,
    path: str | None,
    *,
    update: bool = False,
) -> ExpectedFile | None:
    """The file of expected failures, None where none was given.

    One file may be used for every level, so its entries may match cases that only the levels `deep`
    and `complete` have. Raises ExpectedError, and UsageError for an update of no file.
    """
    if path is None:
        return None
    from bilprov.conformance.api import suite_ids
    from bilprov.conformance.cases.levels import COMPLETE, DEEP
    from bilprov.conformance.report.expected import ExpectedFile

    def known() -> dict[str, None]:
        levels = (replace(options, level=level.name) for level in (DEEP, COMPLETE))
        return dict.fromkeys(ident for one in levels for ident in suite_ids(protocol, one))

    suite = dict.fromkeys(suite_ids(protocol, options))
    return ExpectedFile(path, known, suite, update=update)


def with_expected(report: Report, file: ExpectedFile | None) -> Report:
    """The report with its comparison; prints how many lines of the file were changed."""
    if file is None:
        return report
    compared, changed = file.applied(report)
    if changed:
        note(changed)
    return compared
