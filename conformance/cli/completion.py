"""Values that a shell completes: named faults and legal variants of the simulator."""

from __future__ import annotations

import click

from bilprov.analyzer.grammar_file import load_protocol


def faults(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """The named faults that begin so."""
    from bilprov.conformance.mutation.faults import fault_bank

    return [name for name in fault_bank(load_protocol(ctx.obj)) if name.startswith(incomplete)]


def variants(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """The legal variants that begin so."""
    from bilprov.conformance.mutation.variants import variants as known

    return [name for name in known(load_protocol(ctx.obj)) if name.startswith(incomplete)]
