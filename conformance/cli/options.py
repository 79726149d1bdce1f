"""Options that several commands share: `--fault`, `--variant`, `--seed`; and the profile.

A shell completes the named faults and variants. What makes and selects cases is imported by the
functions that need it: `simulate` needs none.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from bilprov.analyzer.cli.command import option
from bilprov.analyzer.files import read_text
from bilprov.analyzer.grammar_file import load_protocol

if TYPE_CHECKING:
    from bilprov.conformance.dut.simulator import Fault
    from bilprov.spec.protocol import Protocol


def complete_faults(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """The named faults that begin so."""
    from bilprov.conformance.mutation.faults import fault_bank

    return [name for name in fault_bank(load_protocol(ctx.obj)) if name.startswith(incomplete)]


def complete_variants(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """The legal variants that begin so."""
    from bilprov.conformance.mutation.faults import variants as known

    return [name for name in known(load_protocol(ctx.obj)) if name.startswith(incomplete)]


def named_device(protocol: Protocol, fault: str | None, variant: str | None) -> Fault | None:
    """The device that the options name, None for none. Raises UsageError, in one sentence."""
    if fault is not None and variant is not None:
        raise click.UsageError("--fault and --variant are two devices: give one of them")
    if fault is None and variant is None:
        return None
    from bilprov.conformance.mutation.catalogue import find_fault, find_variant

    try:
        if fault is not None:
            return find_fault(protocol, fault)
        return find_variant(protocol, variant or "")
    except ValueError as error:
        raise click.UsageError(str(error)) from error


_PROFILE_BYTES = 1 << 20


def read_profile(protocol: Protocol, path: str | None, allow: tuple[str, ...]) -> str:
    """The text of a profile, "" where none is asked for or its file does not exist yet.

    Raises click's UsageError, in one sentence, for one that does not fit or cannot be written.
    """
    if path is None:
        return ""
    from bilprov.conformance.oracle.profile import parse_allowed, profile_from

    file = Path(path)
    try:
        if not file.exists() and file.absolute().parent.is_dir():
            return ""
        text = read_text(file, _PROFILE_BYTES)
        profile_from(protocol, text, parse_allowed(protocol, allow))
    except (OSError, ValueError) as error:
        why = error.strerror or error if isinstance(error, OSError) else error
        raise click.UsageError(f"--profile {path} cannot be used: {why}") from error
    return text


# Options of several commands.
seed_option = partial(option, type=int, default=1)
fault_option = partial(option, metavar="NAME", shell_complete=complete_faults)
variant_option = partial(option, metavar="NAME", shell_complete=complete_variants)
