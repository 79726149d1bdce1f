"""What a shell offers for the suite's own values: targets, faults, variants, cases, probes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import click

from bilprov.analyzer.cli.completion import Item, beginning, ports, protocol_of

if TYPE_CHECKING:
    from bilprov.spec.protocol import Protocol


def targets(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Item]:
    """The simulator, emulated boards, and the serial ports of this machine."""
    from bilprov.conformance.dut.target import BOARD, SIM, SIMAVR

    own = [(SIM, "the built-in simulator, in virtual time")]
    own += [(f"{BOARD}{SIMAVR}:", "a board's firmware")]
    return beginning(incomplete, own) + ports(ctx, param, incomplete)


def faults(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Item]:
    """The named faults of the simulator; a random one needs a number more."""
    from bilprov.conformance.mutation.faults import fault_bank
    from bilprov.conformance.mutation.random_faults import PREFIX

    bank = fault_bank(protocol_of(ctx))
    named = [(name, fault.doc) for name, fault in bank.items()]
    return beginning(incomplete, [*named, (PREFIX, "and a seed: one that is drawn")])


def variants(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Item]:
    """The legal variants of the simulator."""
    from bilprov.conformance.mutation import variants as known

    found = known.variants(protocol_of(ctx))
    return beginning(incomplete, ((name, variant.doc) for name, variant in found.items()))


def cases(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Item]:
    """The ids of cases, a part of the path at a time: `bad-data/`, then `bad-data/LED/`."""
    parts = dict.fromkeys(_part(one, incomplete) for one in _ids(protocol_of(ctx)))
    return beginning(incomplete, ((part, "") for part in parts))


def _ids(protocol: Protocol) -> Iterator[str]:
    from bilprov.conformance.cases.levels import GENERATORS, STANDARD, single_cases

    yield from (case.id for case in single_cases(protocol, STANDARD.name, 1))
    yield from (f"{generator.group}/*" for generator in GENERATORS)


def _part(ident: str, incomplete: str) -> str:
    """The id up to the first slash behind what was typed."""
    end = ident.find("/", len(incomplete))
    return ident if end < 0 or not ident.startswith(incomplete) else ident[: end + 1]


def probes(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Item]:
    """The kinds of probe."""
    return beginning(incomplete, _probes())


def _probes() -> Iterable[tuple[str, str]]:
    from bilprov.conformance.dut.probes import PROBES

    for kind in PROBES:
        for value in kind.values:
            yield f"{kind.name}:{value}", ""
        if not kind.values:
            yield (f"{kind.name}:" if kind.rest else kind.name), kind.rest
    yield "sim", "the target sim's own"
